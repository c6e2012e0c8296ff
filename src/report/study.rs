//! Named curves over any quantity, as an SVG file that stands alone.

use super::plots::Curve;
use plotters::prelude::*;

/// A plot: what runs along the axes, and its named curves.
#[derive(Debug, Clone)]
pub struct Plot<'a> {
    /// Title.
    pub title: &'a str,
    /// What runs to the right, with its unit.
    pub x: &'a str,
    /// What runs upwards, with its unit.
    pub y: &'a str,
    /// Curves with their names; points whose values are not finite are left out.
    pub curves: &'a [(&'a str, Curve)],
}

/// Width and height, pixels.
const SIZE: (u32, u32) = (720, 440);

/// Draws the plot; `None` without any point.
pub fn svg(plot: &Plot<'_>) -> Option<String> {
    let finite = |p: &(f64, f64)| p.0.is_finite() && p.1.is_finite();
    let all = || plot.curves.iter().flat_map(|(_, c)| c.points.iter().copied()).filter(finite);
    let span = |value: fn((f64, f64)) -> f64| {
        let (low, high) = all().map(value).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let pad = 0.05 * (high - low).max(1e-3 * high.abs()).max(1e-9);
        low - pad..high + pad
    };
    all().next()?;
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        // The backend writes into memory, so none of these calls can fail.
        let memory = "an SVG in memory takes every element";
        area.fill(&WHITE).expect(memory);
        let mut chart = ChartBuilder::on(&area)
            .caption(plot.title, ("sans-serif", 16))
            .margin(10)
            .x_label_area_size(40)
            .y_label_area_size(64)
            .build_cartesian_2d(span(|p| p.0), span(|p| p.1))
            .expect(memory);
        chart.configure_mesh().x_desc(plot.x).y_desc(plot.y).light_line_style(TRANSPARENT).draw().expect(memory);
        for (name, curve) in plot.curves {
            let color = RGBColor(curve.color[0], curve.color[1], curve.color[2]).mix(curve.opacity);
            let points = || curve.points.iter().copied().filter(finite);
            let style = color.stroke_width(curve.width);
            chart
                .draw_series(LineSeries::new(points(), style))
                .expect(memory)
                .label(*name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], style));
            if curve.dots {
                chart.draw_series(points().map(|p| Circle::new(p, 3, color.filled()))).expect(memory);
            }
        }
        chart
            .configure_series_labels()
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()
            .expect(memory);
        area.present().expect(memory);
    }
    Some(svg)
}

/// Two quantities over a third, each with an axis of its own: name, points, colour.
#[derive(Debug, Clone)]
pub struct TwoAxes<'a> {
    /// Title.
    pub title: &'a str,
    /// What runs to the right, with its unit.
    pub x: &'a str,
    /// Name of the quantity on the left axis, and its points.
    pub left: (&'a str, &'a [(f64, f64)]),
    /// Name of the quantity on the right axis, and its points.
    pub right: (&'a str, &'a [(f64, f64)]),
    /// A line under the plot.
    pub note: &'a str,
}

const LEFT: RGBColor = RGBColor(0, 114, 178);
const RIGHT: RGBColor = RGBColor(213, 94, 0);

/// Draws the plot, axes from zero; `None` unless both quantities have a point.
pub fn two_axes(plot: &TwoAxes<'_>) -> Option<String> {
    let finite = |points: &[(f64, f64)]| -> Vec<(f64, f64)> {
        points.iter().copied().filter(|p| p.0.is_finite() && p.1.is_finite()).collect()
    };
    let (left, right) = (finite(plot.left.1), finite(plot.right.1));
    if left.is_empty() || right.is_empty() {
        return None;
    }
    let upper = |values: &mut dyn Iterator<Item = f64>| 1.08 * values.fold(0.0, f64::max).max(1e-9);
    let x_upper = upper(&mut left.iter().chain(&right).map(|p| p.0));
    let y_upper = [&left, &right].map(|points| upper(&mut points.iter().map(|p| p.1)));
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        // The backend writes into memory, so none of these calls can fail.
        let memory = "an SVG in memory takes every element";
        area.fill(&WHITE).expect(memory);
        let (plot_area, note_area) = area.split_vertically(SIZE.1 - 26);
        let mut chart = ChartBuilder::on(&plot_area)
            .caption(plot.title, ("sans-serif", 16))
            .margin(10)
            .x_label_area_size(40)
            .y_label_area_size(72)
            .right_y_label_area_size(72)
            .build_cartesian_2d(0.0..x_upper, 0.0..y_upper[0])
            .expect(memory)
            .set_secondary_coord(0.0..x_upper, 0.0..y_upper[1]);
        chart
            .configure_mesh()
            .x_desc(plot.x)
            .y_desc(plot.left.0)
            .y_label_formatter(&|v| short(*v))
            .light_line_style(TRANSPARENT)
            .draw()
            .expect(memory);
        chart.configure_secondary_axes().y_desc(plot.right.0).draw().expect(memory);
        chart
            .draw_series(left.iter().map(|&p| Circle::new(p, 4, LEFT.filled())))
            .expect(memory)
            .label(plot.left.0)
            .legend(|(x, y)| Circle::new((x + 8, y), 4, LEFT.filled()));
        chart
            .draw_secondary_series(right.iter().map(|&p| TriangleMarker::new(p, 6, RIGHT.filled())))
            .expect(memory)
            .label(plot.right.0)
            .legend(|(x, y)| TriangleMarker::new((x + 8, y), 6, RIGHT.filled()));
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::UpperLeft)
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()
            .expect(memory);
        note_area.draw_text(plot.note, &("sans-serif", 13).into_text_style(&note_area), (14, 4)).expect(memory);
        area.present().expect(memory);
    }
    Some(svg)
}

/// `150000` as `150k`.
fn short(value: f64) -> String {
    if value >= 10_000.0 { format!("{:.0}k", value / 1000.0) } else { format!("{value}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_quantities_have_an_axis_each() {
        let points = [(2.0, 20_000.0), (8.0, 200_000.0)];
        let load = [(2.0, 11.0), (8.0, 43.0)];
        let plot =
            TwoAxes { title: "t", x: "ms", left: ("points", &points), right: ("per tile", &load), note: "r = 1" };
        let drawn = two_axes(&plot).expect("points on both axes");
        for text in ["points", "per tile", "ms", "r = 1", "200k"] {
            assert!(drawn.contains(text), "{text}");
        }
        assert!(two_axes(&TwoAxes { left: ("points", &[]), ..plot }).is_none());
    }

    #[test]
    fn plots_name_axes_and_curves_and_need_a_point() {
        let curve = |points| Curve { points, color: [200, 80, 0], opacity: 1.0, width: 2, dots: true };
        let draw =
            |points| svg(&Plot { title: "t", x: "time, ms", y: "difference", curves: &[("naive", curve(points))] });
        let drawn = draw(vec![(1.0, 2.0), (3.0, f64::NAN)]).expect("one point");
        assert!(drawn.starts_with("<svg") && drawn.contains("time, ms") && drawn.contains("naive"));
        assert!(draw(vec![(f64::NAN, 1.0)]).is_none());
    }
}
