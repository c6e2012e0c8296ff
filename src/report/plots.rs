//! Curves as inline SVG that take their ink from the page, so that they are right in light and dark.

use plotters::coord::combinators::BindKeyPoints;
use plotters::coord::ranged1d::{AsRangedCoord, Ranged, ValueFormatter};
use plotters::prelude::*;

/// Ink of axes and text. A value no curve uses: it is replaced by CSS `currentColor`.
const INK: RGBColor = RGBColor(1, 2, 3);
const INK_HEX: &str = "#010203";

/// Width and height of a plot in its own units; the page scales it to about this many pixels.
const SIZE: (u32, u32) = (420, 240);

/// One curve of a plot.
#[derive(Debug, Clone)]
pub struct Curve {
    /// Points (step, value), in order.
    pub points: Vec<(f64, f64)>,
    /// Colour, visible on white and on black.
    pub color: [u8; 3],
    /// Opacity 0..1.
    pub opacity: f64,
    /// Line width in plot units.
    pub width: u32,
    /// Marks at the points.
    pub dots: bool,
}

/// How the values run along the vertical axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// Evenly.
    Linear,
    /// By powers of ten; all values are above zero.
    Log,
}

/// Draws curves over the training step as an SVG element, or nothing when no curve has two points.
pub fn over_steps(curves: &[Curve], scale: Scale, unit: &str) -> Option<String> {
    let all = || curves.iter().flat_map(|c| c.points.iter().copied()).filter(|p| p.1.is_finite());
    if curves.iter().all(|c| c.points.len() < 2) {
        return None;
    }
    let x_max = all().map(|p| p.0).fold(1.0, f64::max);
    let (low, high) = all().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), p| (l.min(p.1), h.max(p.1)));
    if low > high || (scale == Scale::Log && low <= 0.0) {
        return None;
    }
    let svg = match scale {
        Scale::Linear => {
            let pad = 0.06 * (high - low).max(1e-3 * high.abs()).max(1e-9);
            draw(curves, 0.0..x_max, (low - pad)..(high + pad), unit)
        }
        Scale::Log => {
            let (low, high) = (low * 0.9, high * 1.1);
            let range = (low..high).log_scale().with_key_points(round_values(low, high));
            draw(curves, 0.0..x_max, range, unit)
        }
    };
    // The element scales with the page: its own size becomes the view box alone.
    let (width, height) = SIZE;
    let own_size = format!("<svg width=\"{width}\" height=\"{height}\"");
    Some(svg.replacen(&own_size, "<svg class=\"plot\" role=\"img\"", 1).replace(INK_HEX, "currentColor"))
}

fn draw<Y>(curves: &[Curve], x: std::ops::Range<f64>, y: Y, unit: &str) -> String
where
    Y: AsRangedCoord<Value = f64>,
    Y::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        // The backend writes into memory, so none of these calls can fail.
        let memory = "an SVG in memory takes every element";
        let mut chart = ChartBuilder::on(&area)
            .margin(8)
            .margin_right(24)
            .x_label_area_size(30)
            .y_label_area_size(58)
            .build_cartesian_2d(x, y)
            .expect(memory);
        let text = ("sans-serif", 14).into_font().color(&INK.mix(0.75));
        chart
            .configure_mesh()
            .disable_x_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(INK.mix(0.14))
            .axis_style(INK.mix(0.35))
            .label_style(text)
            .x_labels(6)
            .y_labels(6)
            .x_label_formatter(&|v| step_label(*v))
            .y_label_formatter(&|v| format!("{}{unit}", value_label(*v)))
            .draw()
            .expect(memory);
        for curve in curves {
            let color = RGBColor(curve.color[0], curve.color[1], curve.color[2]).mix(curve.opacity);
            let points = curve.points.iter().copied().filter(|p| p.1.is_finite());
            chart.draw_series(LineSeries::new(points.clone(), color.stroke_width(curve.width))).expect(memory);
            if curve.dots {
                chart.draw_series(points.map(|p| Circle::new(p, 3, color.filled()))).expect(memory);
            }
        }
        area.present().expect(memory);
    }
    svg
}

/// 1, 2 and 5 times the powers of ten between `low` and `high`, both above zero.
fn round_values(low: f64, high: f64) -> Vec<f64> {
    let decades = low.log10().floor() as i32..=high.log10().ceil() as i32;
    let values = decades.flat_map(|decade| [1.0, 2.0, 5.0].map(|digit| digit * 10_f64.powi(decade)));
    values.filter(|value| (low..=high).contains(value)).collect()
}

fn step_label(step: f64) -> String {
    if step >= 1000.0 { format!("{}k", trimmed(step / 1000.0, 1)) } else { trimmed(step, 0) }
}

fn value_label(value: f64) -> String {
    match value.abs() {
        v if v >= 10_000.0 => format!("{}k", trimmed(value / 1000.0, 1)),
        v if v >= 100.0 => trimmed(value, 0),
        v if v >= 1.0 => trimmed(value, 2),
        _ => trimmed(value, 4),
    }
}

/// Fixed decimals without trailing zeros.
fn trimmed(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    if !text.contains('.') {
        return text;
    }
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// Exponentially weighted mean over roughly `window` points: the trend in a noisy curve.
pub fn smoothed(points: &[(f64, f64)], window: f64) -> Vec<(f64, f64)> {
    let weight = 1.0 / window.max(1.0);
    let mut mean = None;
    points
        .iter()
        .map(|&(x, y)| {
            let next = mean.map_or(y, |m: f64| m + weight * (y - m));
            mean = Some(next);
            (x, next)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(points: Vec<(f64, f64)>) -> Curve {
        Curve { points, color: [200, 80, 0], opacity: 1.0, width: 2, dots: true }
    }

    #[test]
    fn plot_is_scalable_and_takes_its_ink_from_the_page() {
        for scale in [Scale::Linear, Scale::Log] {
            let svg = over_steps(&[curve(vec![(0.0, 0.5), (1000.0, 0.02)])], scale, "").expect("two points");
            assert!(svg.starts_with("<svg class=\"plot\"") && svg.contains("viewBox"), "{svg}");
            assert!(svg.contains("currentColor") && !svg.contains(INK_HEX));
        }
    }

    #[test]
    fn curves_that_cannot_be_drawn_are_left_out() {
        assert!(over_steps(&[curve(vec![(0.0, 1.0)])], Scale::Linear, "").is_none());
        assert!(over_steps(&[curve(vec![(0.0, 0.0), (1.0, 1.0)])], Scale::Log, "").is_none());
        assert!(over_steps(&[curve(vec![(0.0, f64::NAN), (1.0, f64::NAN)])], Scale::Linear, "").is_none());
        assert!(over_steps(&[curve(vec![(0.0, 3.0), (1.0, 3.0)])], Scale::Linear, " dB").is_some());
    }

    #[test]
    fn smoothing_keeps_a_constant() {
        assert_eq!(smoothed(&[(0.0, 2.0), (1.0, 2.0)], 10.0), vec![(0.0, 2.0), (1.0, 2.0)]);
    }

    #[test]
    fn logarithmic_axis_is_labelled_at_round_values() {
        assert_eq!(round_values(0.015, 0.4), [0.02, 0.05, 0.1, 0.2]);
    }

    #[test]
    fn labels_are_short() {
        assert_eq!([step_label(30_000.0), step_label(1500.0), value_label(25.5)], ["30k", "1.5k", "25.5"]);
    }
}
