//! Lays a [`Report`] out as one self-contained HTML page.

use super::pictures::{self, ERROR_SCALE};
use super::plots::{self, Curve, Scale};
use super::{Measured, Report, ViewPanel};
use crate::console::{duration, grouped};
use std::fmt::Write as _;

const STYLE: &str = include_str!("style.css");
const SCRIPT: &str = include_str!("script.js");

/// JPEG quality of photographs, renders and error maps; the film is motion and may be coarser.
const QUALITY: u8 = 90;
const FILM_QUALITY: u8 = 80;

const BLUE: [u8; 3] = [64, 132, 244];
const ORANGE: [u8; 3] = [240, 128, 40];
const GREEN: [u8; 3] = [36, 166, 112];

/// The page.
pub fn page(report: &Report) -> String {
    let mut body = String::new();
    header(&mut body, report);
    film(&mut body, report);
    views(&mut body, report);
    curves(&mut body, report);
    timings(&mut body, report);
    details(&mut body, report);
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n<title>{title} · gazesplat</title>\n\
         <style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n{body}</main>\n\
         <footer>gazesplat {version}. This file is complete in itself: it loads nothing.</footer>\n\
         <script>\n{SCRIPT}</script>\n</body>\n</html>\n",
        title = escape(&report.title),
        version = env!("CARGO_PKG_VERSION"),
    )
}

/// Text that may stand between tags and in quoted attributes.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

// Writing into a `String` cannot fail, so the results of `write!` below carry nothing.
macro_rules! put {
    ($out:expr, $($arg:tt)*) => {{ let _ = write!($out, $($arg)*); }};
}

fn header(out: &mut String, report: &Report) {
    put!(out, "<header><p class=\"mark\">gazesplat</p><h1>{}</h1>", escape(&report.title));
    put!(out, "<p class=\"lead\">{}</p></header>\n", escape(&report.subtitle));
    if !report.headline.is_empty() {
        put!(out, "<section class=\"figures\">");
        for f in &report.headline {
            put!(out, "<div><b>{}<small>{}</small></b>", escape(&f.value), escape(&f.unit));
            put!(out, "<span>{}</span></div>", escape(&f.label));
        }
        put!(out, "</section>\n");
    }
    for warning in &report.warnings {
        put!(out, "<p class=\"warning\">{}</p>\n", escape(warning));
    }
}

fn film(out: &mut String, report: &Report) {
    let Some(first) = report.film.first() else { return };
    put!(
        out,
        "<section><h2>Fly-through</h2><p>The trained model along a path of cameras that no photograph was taken from."
    );
    put!(
        out,
        " Drag to move, press the button to play.</p><div class=\"film\" style=\"--aspect:{}/{}\">",
        first.width,
        first.height
    );
    for frame in &report.film {
        put!(out, "<img alt=\"\" src=\"{}\">", pictures::data_uri(frame, FILM_QUALITY));
    }
    let last = report.film.len() - 1;
    put!(out, "</div><div class=\"controls\"><button type=\"button\" aria-label=\"Play or pause\">❚❚</button>");
    put!(out, "<input type=\"range\" min=\"0\" max=\"{last}\" value=\"0\" aria-label=\"Frame\"></div></section>\n");
}

fn views(out: &mut String, report: &Report) {
    let Some((first, rest)) = report.views.split_first() else { return };
    let (heading, which) = match report.measured {
        Measured::Test => ("Test views", "that training never saw"),
        Measured::Training => ("Training views", "that the model was trained on"),
    };
    put!(out, "<section><h2>{heading}</h2><p>Photographs {which}, beside what the model makes of them. ");
    put!(out, "Drag across the first: left of the line is the photograph, right of it the render.</p>");
    comparison(out, first);
    for view in rest {
        triple(out, view);
    }
    put!(out, "<p class=\"legend\"><i style=\"background:{}\"></i>", pictures::heat_gradient());
    put!(out, "absolute difference, 0 to {ERROR_SCALE} of full scale and above</p></section>\n");
}

fn caption(view: &ViewPanel) -> String {
    format!("<b>{}</b> <span>{:.2} dB</span> <span>SSIM {:.3}</span>", escape(&view.name), view.psnr, view.ssim)
}

fn comparison(out: &mut String, view: &ViewPanel) {
    let (truth, render) = (pictures::data_uri(&view.truth, QUALITY), pictures::data_uri(&view.render, QUALITY));
    let error = pictures::data_uri(&pictures::error_map(&view.truth, &view.render), QUALITY);
    let (w, h) = (view.truth.width, view.truth.height);
    put!(out, "<figure><div class=\"pair\" style=\"--aspect:{w}/{h}\"><div class=\"compare\">");
    put!(out, "<img alt=\"photograph\" src=\"{truth}\"><img class=\"over\" alt=\"render\" src=\"{render}\">");
    put!(out, "<i></i><input type=\"range\" min=\"0\" max=\"100\" value=\"50\" step=\"0.1\" aria-label=\"Compare\">");
    put!(out, "<em class=\"tag\">photograph</em><em class=\"tag right\">render</em></div>");
    put!(
        out,
        "<div class=\"cell\"><img alt=\"difference\" src=\"{error}\"><em class=\"tag\">difference</em></div></div>"
    );
    put!(out, "<figcaption>{}</figcaption></figure>\n", caption(view));
}

fn triple(out: &mut String, view: &ViewPanel) {
    let error = pictures::error_map(&view.truth, &view.render);
    put!(out, "<figure><div class=\"triple\">");
    for (name, image) in [("photograph", &view.truth), ("render", &view.render), ("difference", &error)] {
        put!(
            out,
            "<div class=\"cell\"><img loading=\"lazy\" alt=\"{name}\" src=\"{}\">",
            pictures::data_uri(image, QUALITY)
        );
        put!(out, "<em class=\"tag\">{name}</em></div>");
    }
    put!(out, "</div><figcaption>{}</figcaption></figure>\n", caption(view));
}

fn curves(out: &mut String, report: &Report) {
    let line = |points, color, opacity, width| Curve { points, color, opacity, width, dots: false };
    let loss: Vec<(f64, f64)> = report.steps.iter().map(|s| (f64::from(s.step), f64::from(s.loss))).collect();
    let trend = plots::smoothed(&loss, loss.len() as f64 / 40.0);
    let count = report.steps.iter().map(|s| (f64::from(s.step), s.num_gaussians as f64)).collect();
    let psnr = report.test_psnr.iter().map(|&(step, db)| (f64::from(step), db)).collect();
    let psnr_name = format!("PSNR on the {} views", report.measured.name());
    let plots = [
        ("Loss", plots::over_steps(&[line(loss, ORANGE, 0.3, 1), line(trend, ORANGE, 1.0, 2)], Scale::Log, "")),
        (
            psnr_name.as_str(),
            plots::over_steps(&[Curve { dots: true, ..line(psnr, BLUE, 1.0, 2) }], Scale::Linear, " dB"),
        ),
        ("Gaussians", plots::over_steps(&[line(count, GREEN, 1.0, 2)], Scale::Linear, "")),
    ];
    if plots.iter().all(|(_, svg)| svg.is_none()) {
        return;
    }
    put!(out, "<section><h2>Training</h2><div class=\"plots\">");
    for (name, svg) in &plots {
        if let Some(svg) = svg {
            put!(out, "<figure><figcaption><b>{name}</b> over the step</figcaption>{svg}</figure>");
        }
    }
    put!(out, "</div></section>\n");
}

fn timings(out: &mut String, report: &Report) {
    if report.stages.is_empty() && report.step_ms <= 0.0 && report.durations.is_empty() {
        return;
    }
    put!(out, "<section><h2>Time</h2>");
    let total: f64 = report.stages.iter().map(|s| s.1).sum();
    if total > 0.0 {
        put!(out, "<p>A training step took {total:.1} ms on average:</p><div class=\"bar\">");
        for (i, (name, ms)) in report.stages.iter().enumerate() {
            let share = 100.0 * ms / total;
            put!(out, "<i class=\"s{i}\" style=\"flex-grow:{share:.3}\" title=\"{} {ms:.2} ms\"></i>", escape(name));
        }
        put!(out, "</div><ul class=\"key\">");
        for (i, (name, ms)) in report.stages.iter().enumerate() {
            put!(out, "<li><i class=\"s{i}\"></i>{} <b>{ms:.2} ms</b> {:.0} %</li>", escape(name), 100.0 * ms / total);
        }
        put!(out, "</ul>");
    } else if report.step_ms > 0.0 {
        put!(
            out,
            "<p>A training step took {:.1} ms on average. Its stages have no times of their own: ",
            report.step_ms
        );
        put!(out, "a GPU works on what is queued while the next stage is being queued.</p>");
    }
    if !report.durations.is_empty() {
        put!(out, "<table>");
        for (name, secs) in &report.durations {
            put!(out, "<tr><th>{}</th><td>{}</td></tr>", escape(name), duration(*secs));
        }
        put!(out, "</table>");
    }
    put!(out, "</section>\n");
}

fn details(out: &mut String, report: &Report) {
    if !report.facts.is_empty() {
        put!(out, "<section><h2>Scene and model</h2><table>");
        for (name, value) in &report.facts {
            put!(out, "<tr><th>{}</th><td>{}</td></tr>", escape(name), escape(value));
        }
        put!(out, "</table></section>\n");
    }
    if !report.scores.is_empty() {
        let (count, which) = (grouped(report.scores.len()), report.measured.name());
        put!(out, "<section><details><summary>All {count} {which} views</summary><table>");
        put!(out, "<tr><th>view</th><th>PSNR</th><th>SSIM</th></tr>");
        for (name, psnr, ssim) in &report.scores {
            put!(out, "<tr><td>{}</td><td>{psnr:.2} dB</td><td>{ssim:.4}</td></tr>", escape(name));
        }
        put!(out, "</table></details></section>\n");
    }
    if !report.settings.is_empty() {
        put!(
            out,
            "<section><details><summary>Settings</summary><pre>{}</pre></details></section>\n",
            escape(&report.settings)
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::{Figure, StepPoint};
    use gazesplat_core::RgbImage8;

    fn sample() -> Report {
        let gray = |v| RgbImage8 { width: 8, height: 6, data: vec![v; 144] };
        let view =
            |name: &str| ViewPanel { name: name.into(), truth: gray(90), render: gray(99), psnr: 29.0, ssim: 0.9 };
        Report {
            title: "<b>&\"room\"".into(),
            headline: vec![Figure::new("29.00", "dB", "PSNR")],
            steps: (0..20)
                .map(|i| StepPoint { step: i * 10, loss: 0.5 / (i + 1) as f32, num_gaussians: 100 })
                .collect(),
            test_psnr: vec![(100, 20.0), (200, 25.0)],
            stages: vec![("forward".into(), 3.0), ("backward".into(), 5.0)],
            views: vec![view("a.png"), view("b.png")],
            film: vec![gray(1), gray(2)],
            settings: "[train]\nsteps = 1\n".into(),
            ..Report::default()
        }
    }

    #[test]
    fn page_loads_nothing_from_outside() {
        let html = page(&sample());
        // The one address allowed is the SVG namespace, which is a name and is not fetched.
        let without_namespace = html.replace("http://www.w3.org/2000/svg", "");
        for outside in ["http://", "https://", "<link", "@import", "url("] {
            assert!(!without_namespace.contains(outside), "{outside}");
        }
    }

    #[test]
    fn text_of_the_user_is_escaped() {
        let html = page(&sample());
        assert!(html.contains("<h1>&lt;b&gt;&amp;&quot;room&quot;</h1>"));
        assert!(!html.contains("<b>&\"room"));
    }

    #[test]
    fn every_part_with_content_is_shown_and_no_other() {
        let html = page(&sample());
        for part in ["Fly-through", "Test views", "Loss", "PSNR on the test views", "Gaussians", "Time", "Settings"] {
            assert!(html.contains(part), "{part}");
        }
        assert!(html.contains("backward <b>5.00 ms</b> 62 %") && !html.contains("no times of their own"));
        let on_gpu = page(&Report { stages: Vec::new(), step_ms: 2.5, ..sample() });
        assert!(on_gpu.contains("took 2.5 ms on average. Its stages have no times") && !on_gpu.contains("backward"));
        let trained_on = page(&Report { measured: Measured::Training, ..sample() });
        assert!(trained_on.contains("Training views") && trained_on.contains("PSNR on the training views"));
        assert!(!trained_on.contains("Test views") && !trained_on.contains("never saw"));
        let empty = page(&Report { title: "x".into(), ..Report::default() });
        for part in ["Fly-through", "Test views", "Loss", "Time", "Settings"] {
            assert!(!empty.contains(part), "{part}");
        }
    }
}
