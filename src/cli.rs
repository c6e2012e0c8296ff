//! The command line: what is accepted, explained, and which command it becomes. Nothing is opened here.

use crate::commands::{bench, convert, demo, eval, hvsq, info, lut, prune, render, synth, train};
use crate::console::Console;
use crate::diagnostics::Result;
use crate::settings;
use clap::{Args, CommandFactory, FromArgMatches, Parser, Subcommand};
use gazesplat_render::DeviceChoice;
use std::path::PathBuf;
use tracing_subscriber::EnvFilter;

/// Turn photographs with known cameras into 3D Gaussian models, on the CPU or a GPU.
#[derive(Debug, Parser)]
#[command(
    name = "gazesplat",
    version,
    propagate_version = true,
    arg_required_else_help = true,
    max_term_width = 110,
    after_help = "\
SCENE is a COLMAP directory (`sparse/0` in .bin or .txt, beside `images`), a directory with
`transforms.json` (nerfstudio, instant-ngp, NeRF-synthetic), or made by `gazesplat synth`.
MODEL is the directory of a run, or a file: 3DGS PLY, compressed PLY, `.splat` or SPZ.

Examples:
  gazesplat demo                                       see everything work, in a few minutes
  gazesplat train my_capture --config quick            a first model of your own capture
  gazesplat eval runs/my_capture-1 --scene my_capture  PSNR and SSIM on the views kept for testing
  gazesplat render runs/my_capture-1 --scene my_capture --out frames
  gazesplat info --devices                             what --device gpu would use

Standard output is data, standard error is for people.
Exit status: 0 done, 1 a check you asked for failed, 2 error."
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
    /// How much to tell.
    #[command(flatten)]
    pub verbosity: Verbosity,
}

/// How much the program tells on standard error.
#[derive(Debug, Clone, Copy, Args)]
pub struct Verbosity {
    /// Tell warnings and errors only
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub quiet: bool,
    /// Tell what is going on inside: -v decisions, -vv details
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Train a Gaussian model on the photographs of a scene
    Train(train::TrainArgs),
    /// Make a model several times faster to draw at a quality that is held
    Prune(Box<prune::PruneArgs>),
    /// Measure a model against the photographs of a scene: PSNR and SSIM
    Eval(eval::EvalArgs),
    /// Measure how different two pictures look in the corner of the eye
    Hvsq(hvsq::HvsqCommandArgs),
    /// Draw a model from the cameras of a scene or along a camera path
    Render(render::RenderArgs),
    /// Write a procedural scene: photographs, cameras and sparse points
    Synth(synth::SynthArgs),
    /// See the whole way once: make a scene, train, measure, render, report
    Demo(demo::DemoArgs),
    /// Say what is in a model, a scene, a camera path or a run; or which devices there are
    Info(info::InfoArgs),
    /// Write a model in another format: PLY, compressed PLY, `.splat` or SPZ
    Convert(convert::ConvertArgs),
    /// Write a table of the transmittances at which a pixel may stop, from colour science
    Lut(lut::LutArgs),
    /// Measure what a part of the program gains and costs
    Bench(bench::BenchArgs),
}

/// Parses the arguments of this process and runs the command.
///
/// Ends the process directly for `--help`, `--version` and arguments that do not parse (status 2).
///
/// # Errors
/// Whatever the command fails with.
pub fn run() -> Result<()> {
    let with_keys = |schema: &'static settings::Schema| {
        move |c: clap::Command| {
            let examples = c.get_after_help().map(ToString::to_string).unwrap_or_default();
            let keys = settings::describe_keys(schema);
            c.after_long_help(format!("{examples}\n\nSettings for --set and --config, with their defaults:\n{keys}"))
        }
    };
    let command = Cli::command().mut_subcommand("train", with_keys(&settings::TRAIN));
    let matches = command.mut_subcommand("prune", with_keys(&settings::PRUNE)).get_matches();
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|e| e.exit());
    start_log(cli.verbosity);
    let console = Console::new(cli.verbosity.quiet);
    let console = if cli.verbosity.verbose > 0 { console.without_bars() } else { console };
    match cli.command {
        Command::Train(args) => train::command(&args, &console),
        Command::Prune(args) => prune::command(&args, &console),
        Command::Eval(args) => eval::command(&args, &console),
        Command::Hvsq(args) => hvsq::command(&args, &console),
        Command::Render(args) => render::command(&args, &console),
        Command::Synth(args) => synth::command(&args, &console),
        Command::Demo(args) => demo::command(&args, &console),
        Command::Info(args) => info::command(&args, &console),
        Command::Convert(args) => convert::command(&args, &console),
        Command::Lut(args) => lut::command(&args, &console),
        Command::Bench(args) => bench::command(&args, &console),
    }
}

/// `-v` shows the decisions of our crates, `-vv` their details; `RUST_LOG` replaces both.
fn start_log(verbosity: Verbosity) {
    let level = match verbosity.verbose {
        0 => "error",
        1 => "info",
        _ => "debug",
    };
    let ours = ["gazesplat", "gazesplat_core", "gazesplat_render", "gazesplat_train"];
    let default = ours.map(|c| format!("{c}={level}")).join(",");
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(default));
    // A second start, as tests in one process make it, keeps the first.
    let _ = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).without_time().try_init();
}

/// Settings, as `train`, `eval` and others take them.
#[derive(Debug, Clone, Default, Args)]
pub struct SettingsArgs {
    /// Settings that differ from the defaults: a TOML file, or the preset `quick` or `quality`
    #[arg(long, value_name = "FILE|PRESET")]
    pub config: Option<PathBuf>,
    /// One setting over those of --config; may be repeated. Example: --set train.steps=3000
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
}

/// Where a command computes.
#[derive(Debug, Clone, Copy, Default, Args)]
pub struct DeviceArgs {
    /// Where to compute: cpu, gpu (the best adapter, a software driver where there is no other) or gpu:N, numbered as
    /// in `gazesplat info --devices`
    #[arg(long, value_name = "DEVICE", default_value_t)]
    pub device: DeviceChoice,
}

/// An image size given as `WIDTHxHEIGHT`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

/// Sides beyond this are a slip of the finger: 16384² is a gigabyte per frame in `f32`.
const MAX_SIDE: u32 = 16_384;

/// Reads `WIDTHxHEIGHT`.
///
/// # Errors
/// What is wrong with the text, for clap to show.
pub fn parse_size(text: &str) -> std::result::Result<Size, String> {
    let parse = |s: &str| s.trim().parse::<u32>().ok().filter(|n| (1..=MAX_SIDE).contains(n));
    text.split_once(['x', 'X', '×'])
        .and_then(|(w, h)| Some(Size { width: parse(w)?, height: parse(h)? }))
        .ok_or_else(|| format!("expected WIDTHxHEIGHT in pixels, each 1 to {MAX_SIDE}, such as 1280x720"))
}

/// Reads `r,g,b` with channels 0..1.
///
/// # Errors
/// What is wrong with the text, for clap to show.
pub fn parse_rgb(text: &str) -> std::result::Result<[f32; 3], String> {
    let channels: Vec<f32> = text.split(',').filter_map(|c| c.trim().parse().ok()).collect();
    match <[f32; 3]>::try_from(channels) {
        Ok(rgb) if text.split(',').count() == 3 && rgb.iter().all(|c| (0.0..=1.0).contains(c)) => Ok(rgb),
        _ => Err("expected three channels from 0 to 1, such as 1,1,1 for white".to_owned()),
    }
}

/// Reads a field of view in degrees.
///
/// # Errors
/// What is wrong with the text, for clap to show.
pub fn parse_fov_deg(text: &str) -> std::result::Result<f32, String> {
    text.parse().ok().filter(|d| (1.0..=170.0).contains(d)).ok_or_else(|| "expected 1 to 170 degrees".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn sizes_and_colours_refuse_nonsense() {
        assert_eq!(parse_size("640x480"), Ok(Size { width: 640, height: 480 }));
        for bad in ["640", "0x5", "640x-1", "99999x1", "axb"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
        assert_eq!(parse_rgb("1, 0.5,0"), Ok([1.0, 0.5, 0.0]));
        for bad in ["1,1", "1,1,1,1", "2,0,0", "1,x,1,1", "NaN,0,0"] {
            assert!(parse_rgb(bad).is_err(), "{bad}");
        }
        assert!(parse_fov_deg("90").is_ok() && parse_fov_deg("NaN").is_err() && parse_fov_deg("0").is_err());
    }
}
