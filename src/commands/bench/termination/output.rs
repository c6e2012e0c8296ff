//! What the study leaves behind: tables, plots, maps.

use super::super::super::device::ComputeDevice;
use super::super::super::vector_instructions;
use super::stops::Stops;
use super::{Row, THRESHOLDS};
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
    /// FLIP.
    pub flip: Vec<f32>,
    /// Part of the blends of the fixed rule that is saved.
    pub saved: Vec<f32>,
}

/// Everything that is written.
pub(super) struct Results<'a> {
    pub model: &'a Path,
    pub device: &'a ComputeDevice,
    pub views: &'a [View],
    pub pixels_per_degree: f64,
    pub rows: &'a [Row],
    pub stops: &'a Stops,
    pub maps: Maps,
}

/// Writes all files into `dir`.
pub(super) fn write(dir: &Path, results: &Results<'_>) -> Result<()> {
    create_all(dir)?;
    write_text(&dir.join("termination.csv"), &csv(results.rows))?;
    let views: Vec<&str> = results.views.iter().map(|v| v.name.as_str()).collect();
    // Every row has LPIPS, or none.
    let not_measured: &[&str] = match results.rows.iter().all(|row| row.lpips.is_some()) {
        true => &[],
        false => &["LPIPS: its weights are given with `--lpips-weights`"],
    };
    let report = json!({
        "model": results.model.display().to_string(),
        "device": results.device.describe(),
        "threads": rayon::current_num_threads(),
        "vector_instructions": vector_instructions(),
        "views": views,
        "pixels_per_degree": results.pixels_per_degree,
        "delta_e_thresholds": THRESHOLDS,
        "stops_of_strict": results.stops,
        "not_measured": not_measured,
        "rows": results.rows,
    });
    write_text(&dir.join("termination.json"), &format!("{}\n", to_json(&report)))?;
    let over_time = |r: &Row| Some((r.ms, r.delta_e_p999));
    let flip_over_time = |r: &Row| Some((r.ms, r.flip));
    let over_gamma = |r: &Row| Some((f64::from(r.gamma?), r.psnr));
    for (file, title, x, y, value) in [
        (
            "error_over_time.svg",
            "Difference from the full image",
            "ms per frame",
            "ΔE₀₀, 99.9th percentile",
            &over_time as &dyn Fn(&Row) -> Option<(f64, f64)>,
        ),
        (
            "flip_over_time.svg",
            "Difference that is seen in the full image",
            "ms per frame",
            "FLIP, mean",
            &flip_over_time,
        ),
        ("quality_over_gamma.svg", "Quality against the photographs", "γ", "PSNR, dB", &over_gamma),
    ] {
        let curve = |prefix: &str, color: [u8; 3]| {
            let is_of = |rule: &str| match prefix {
                "strict" => rule == prefix,
                _ => rule.starts_with(prefix),
            };
            let rows = results.rows.iter().filter(|r| is_of(&r.rule));
            // Rules of one name at several γ are a curve; the naive ones are constants of their own.
            let width = if prefix == "naive" { 0 } else { 2 };
            Curve { points: rows.filter_map(value).collect(), color, opacity: 1.0, width, dots: true }
        };
        let curves = [
            ("strict", curve("strict", [0, 114, 178])),
            ("paper", curve("paper", [213, 94, 0])),
            ("naive", curve("naive", [110, 110, 110])),
            ("fixed", curve("fixed", [0, 158, 115])),
            ("given", curve("given", [204, 121, 167])),
        ];
        if let Some(svg) = svg(&Plot { title, x, y, curves: &curves }) {
            write_text(&dir.join(file), &svg)?;
        }
    }
    let Maps { width, height, delta_e, flip, saved } = &results.maps;
    for (file, values, brightest) in [("delta_e.png", delta_e, 1.0), ("flip.png", flip, 0.1), ("saved.png", saved, 1.0)]
    {
        let data = values.iter().flat_map(|&v| heat(v / brightest)).collect();
        io::save_png(dir.join(file), &RgbImage8 { width: *width, height: *height, data })?;
    }
    Ok(())
}

/// The rows as comma-separated values.
fn csv(rows: &[Row]) -> String {
    type Column = (&'static str, fn(&Row) -> f64);
    let columns: [Column; 12] = [
        ("psnr", |r| r.psnr),
        ("ssim", |r| r.ssim),
        ("psnr_to_full", |r| r.psnr_to_full),
        ("delta_e_max", |r| r.delta_e_max),
        ("delta_e_p999", |r| r.delta_e_p999),
        ("above_one", |r| r.above_one),
        ("flip", |r| r.flip),
        ("flip_p999", |r| r.flip_p999),
        ("blends_per_pixel", |r| r.blends_per_pixel),
        ("lane_pixels_per_pixel", |r| r.lane_pixels_per_pixel),
        ("ms", |r| r.ms),
        ("speed_up", |r| r.speed_up),
    ];
    let has_lpips = rows.iter().any(|row| row.lpips.is_some());
    let lpips_name = if has_lpips { ",lpips" } else { "" };
    let mut text = format!("rule,gamma,{}{lpips_name}\n", columns.map(|c| c.0).join(","));
    for r in rows {
        let gamma = r.gamma.map_or_else(String::new, |g| g.to_string());
        let values = columns.map(|(_, value)| value(r).to_string()).join(",");
        let lpips = r.lpips.map_or_else(String::new, |value| format!(",{value}"));
        text.push_str(&format!("\"{}\",{gamma},{values}{lpips}\n", r.rule));
    }
    text
}

/// The rows for people.
pub(super) fn table(rows: &[Row]) -> String {
    let width = rows.iter().map(|r| r.rule.chars().count()).max().unwrap_or(0);
    let mut lines = vec![format!(
        "{:width$}  {:>6}  {:>6}  {:>6}  {:>7}  {:>7}  {:>7}  {:>7}  {:>7}  {:>7}  {:>8}  {:>8}",
        "rule", "γ", "PSNR", "SSIM", "to full", "ΔE max", "ΔE 99.9", "FLIP", "blends", "lanes", "ms", "speed-up"
    )];
    if rows.iter().any(|row| row.lpips.is_some()) {
        lines[0].push_str("    LPIPS");
    }
    for r in rows {
        let gamma = r.gamma.map_or_else(String::new, |g| format!("{g:.3}"));
        lines.push(format!(
            "{:width$}  {gamma:>6}  {:>6.2}  {:>6.4}  {:>7.2}  {:>7.3}  {:>7.3}  {:>7.5}  {:>7.2}  {:>7.1}  {:>8.2}  {:>7.3}×",
            r.rule,
            r.psnr,
            r.ssim,
            r.psnr_to_full,
            r.delta_e_max,
            r.delta_e_p999,
            r.flip,
            r.blends_per_pixel,
            r.lane_pixels_per_pixel,
            r.ms,
            r.speed_up
        ));
        if let (Some(line), Some(lpips)) = (lines.last_mut(), r.lpips) {
            line.push_str(&format!("  {lpips:>7.5}"));
        }
    }
    lines.join("\n")
}
