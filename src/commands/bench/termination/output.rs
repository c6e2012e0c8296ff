//! What the study leaves behind: tables, plots, maps.

use super::super::super::device::ComputeDevice;
use super::super::super::vector_instructions;
use super::Row;
use crate::diagnostics::Result;
use crate::report::pictures::heat;
use crate::report::plots::Curve;
use crate::report::study::{Plot, svg};
use crate::run_dir::{create_all, to_json, write_text};
use gazesplat_core::{RgbImage8, View, io};
use serde_json::json;
use std::path::Path;

/// Maps of one view, `[H·W]`.
pub(super) struct Maps {
    pub width: u32,
    pub height: u32,
    /// ΔE₀₀.
    pub delta_e: Vec<f32>,
    /// Transmittance left, in parts of the largest limit.
    pub left: Vec<f32>,
}

/// Everything that is written.
pub(super) struct Results<'a> {
    pub model: &'a Path,
    pub device: &'a ComputeDevice,
    pub views: &'a [View],
    pub rows: &'a [Row],
    /// Limits of the centred residual over those of the dropped one, mean over the pixels that stopped.
    pub ratio: f64,
    pub maps: Maps,
}

/// Writes all files into `dir`.
pub(super) fn write(dir: &Path, results: &Results<'_>) -> Result<()> {
    create_all(dir)?;
    write_text(&dir.join("termination.csv"), &csv(results.rows))?;
    let views: Vec<&str> = results.views.iter().map(|v| v.name.as_str()).collect();
    let report = json!({
        "model": results.model.display().to_string(),
        "device": results.device.describe(),
        "threads": rayon::current_num_threads(),
        "vector_instructions": vector_instructions(),
        "views": views,
        "centred_over_dropped_limit": results.ratio,
        "rows": results.rows,
    });
    write_text(&dir.join("termination.json"), &format!("{}\n", to_json(&report)))?;
    let over_time = |r: &Row| Some((r.ms, r.delta_e_p999));
    let over_gamma = |r: &Row| Some((f64::from(r.gamma?), r.psnr));
    for (file, title, x, y, value) in [
        (
            "error_over_time.svg",
            "Difference from the full image",
            "ms per frame",
            "ΔE₀₀, 99.9th percentile",
            &over_time as &dyn Fn(&Row) -> Option<(f64, f64)>,
        ),
        ("quality_over_gamma.svg", "Quality against the photographs", "γ", "PSNR, dB", &over_gamma),
    ] {
        let curve = |prefix: &str, color: [u8; 3]| {
            let rows = results.rows.iter().filter(|r| r.rule.starts_with(prefix));
            Curve { points: rows.filter_map(value).collect(), color, opacity: 1.0, width: 2, dots: true }
        };
        let curves = [
            ("strict", curve("strict", [0, 114, 178])),
            ("paper", curve("paper", [213, 94, 0])),
            ("naive", curve("naive", [110, 110, 110])),
            ("fixed 1e-4", curve("fixed", [0, 158, 115])),
        ];
        if let Some(svg) = svg(&Plot { title, x, y, curves: &curves }) {
            write_text(&dir.join(file), &svg)?;
        }
    }
    let Maps { width, height, delta_e, left } = &results.maps;
    for (file, values) in [("delta_e.png", delta_e), ("left.png", left)] {
        let data = values.iter().flat_map(|&v| heat(v)).collect();
        io::save_png(dir.join(file), &RgbImage8 { width: *width, height: *height, data })?;
    }
    Ok(())
}

/// The rows as comma-separated values.
fn csv(rows: &[Row]) -> String {
    let mut text =
        "rule,gamma,psnr,ssim,psnr_to_full,delta_e_max,delta_e_p999,above_one,blends_per_pixel,ms,speed_up\n"
            .to_owned();
    for r in rows {
        let gamma = r.gamma.map_or_else(String::new, |g| g.to_string());
        text.push_str(&format!(
            "\"{}\",{gamma},{},{},{},{},{},{},{},{},{}\n",
            r.rule,
            r.psnr,
            r.ssim,
            r.psnr_to_full,
            r.delta_e_max,
            r.delta_e_p999,
            r.above_one,
            r.blends_per_pixel,
            r.ms,
            r.speed_up
        ));
    }
    text
}

/// The rows for people.
pub(super) fn table(rows: &[Row]) -> String {
    let width = rows.iter().map(|r| r.rule.chars().count()).max().unwrap_or(0);
    let mut lines = vec![format!(
        "{:width$}  {:>6}  {:>6}  {:>6}  {:>7}  {:>7}  {:>7}  {:>7}  {:>8}  {:>8}",
        "rule", "γ", "PSNR", "SSIM", "to full", "ΔE max", "ΔE 99.9", "blends", "ms", "speed-up"
    )];
    for r in rows {
        let gamma = r.gamma.map_or_else(String::new, |g| format!("{g:.3}"));
        lines.push(format!(
            "{:width$}  {gamma:>6}  {:>6.2}  {:>6.4}  {:>7.2}  {:>7.3}  {:>7.3}  {:>7.2}  {:>8.2}  {:>7.3}×",
            r.rule, r.psnr, r.ssim, r.psnr_to_full, r.delta_e_max, r.delta_e_p999, r.blends_per_pixel, r.ms, r.speed_up
        ));
    }
    lines.join("\n")
}
