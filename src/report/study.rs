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

#[cfg(test)]
mod tests {
    use super::*;

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
