//! How much transmittance may be left at a pixel before what is hidden behind it can be seen.
//!
//! What a pixel can still receive at transmittance T is a colour of the cube [0, T·c_max]³ (JND Eq. 2–4, App. A). Its
//! limit at a colour is the side of the largest such cube whose every point differs by at most one just-noticeable
//! difference from what is shown instead. One JND is `jnd_de` units of ΔE₀₀.
//!
//! Shown is the colour itself ([`Region::Corner`]: the rest is dropped), or the middle of the cube ([`Region::Centred`],
//! ours): the latter halves the distance, so that its limit is never below the former's and up to twice as large.

use gazesplat_core::color::ColorSpace;
use gazesplat_core::color::ciede2000::delta_e;
use gazesplat_core::color::cones::dkl_from_linear;
use gazesplat_core::color::lab::{lab_from_linear, lab_from_srgb};
use gazesplat_core::color::metric::{metric_linear, metric_srgb};
use gazesplat_core::color::xyz::{decode_slope, linear_from_srgb};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// How the limit at a colour is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// The smallest limit over the corners of the cube by the metric of ΔE₀₀ (JND Eq. 7). Convex, so that the corners
    /// stand for every residual.
    Vertex,
    /// The largest cube by ΔE₀₀ itself, colours clamped to 0…1 as a display clamps them: no quadratic model.
    Exact,
    /// The smallest half axis along the cone-opponent axes (JND Sec. 3.3), the paper's. It depends on the units of the axes.
    DklDiagonal,
    /// The ellipsoid with half axes along the cone-opponent axes (JND Eq. 6), then the corners (JND Eq. 7).
    DklVertex,
}

/// Where the cube of residuals lies around what is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Region {
    /// What is shown is its darkest corner.
    Corner,
    /// What is shown is its middle.
    Centred,
}

/// An observer of colours, and what it takes to be noticed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observer {
    /// How limits are found.
    pub rule: Rule,
    /// The space in which colours are composited and transmittances count.
    pub space: ColorSpace,
    /// Where the residuals lie.
    pub region: Region,
    /// One just-noticeable difference in units of ΔE₀₀, above 0.
    pub jnd_de: f64,
}

/// Up to one JND the quadratic model is within a tenth of ΔE₀₀ (largest 1.095, measured over the gamut): whatever it holds
/// to be this much farther away is not measured.
const QUADRATIC_MARGIN: f64 = 1.25;

/// Corners of a cube as {0, 1}³.
fn corners() -> impl Iterator<Item = DVec3> {
    (0..8_u32).map(|bits| DVec3::new(f64::from(bits >> 2 & 1), f64::from(bits >> 1 & 1), f64::from(bits & 1)))
}

impl Observer {
    /// The limit at `color` in 0…1: the largest side T of the cube of residuals, at most 1 by [`Rule::Exact`].
    pub fn limit(&self, color: DVec3) -> f64 {
        match self.rule {
            Rule::Vertex => self.quadratic_limit(color),
            Rule::Exact => self.exact_limit(color),
            Rule::DklDiagonal => {
                let lambda = self.dkl_axes(color);
                self.jnd_de / lambda.max_element().sqrt()
            }
            Rule::DklVertex => {
                let m = dkl_from_linear();
                let q = m.transpose() * DMat3::from_diagonal(self.dkl_axes(color)) * m;
                let slope = match self.space {
                    ColorSpace::Srgb => DMat3::from_diagonal(color.map(decode_slope)),
                    ColorSpace::Linear => DMat3::IDENTITY,
                };
                self.smallest_over_corners(slope * q * slope)
            }
        }
    }

    /// The limit by the metric (JND Eq. 7): min over v of 1/√(vᵀGv), v ∈ {0, 1}³; centred 2/√(vᵀGv), v ∈ {±1}³.
    fn quadratic_limit(&self, color: DVec3) -> f64 {
        self.smallest_over_corners(self.metric(color))
    }

    /// G in the space of the colours.
    fn metric(&self, color: DVec3) -> DMat3 {
        match self.space {
            ColorSpace::Srgb => metric_srgb(color),
            ColorSpace::Linear => metric_linear(color),
        }
    }

    /// From what is shown to corner `corner` of the cube of side 1.
    fn offset(&self, corner: DVec3) -> DVec3 {
        match self.region {
            Region::Corner => corner,
            Region::Centred => corner - DVec3::splat(0.5),
        }
    }

    fn corner_limit(&self, metric: DMat3, corner: DVec3) -> f64 {
        let offset = self.offset(corner);
        self.jnd_de / offset.dot(metric * offset).sqrt()
    }

    fn smallest_over_corners(&self, metric: DMat3) -> f64 {
        // The corner that is shown itself has the limit ∞.
        corners().map(|v| self.corner_limit(metric, v)).fold(f64::INFINITY, f64::min)
    }

    /// λ_ii of M⁻ᵀ G M⁻¹: squared inverse half axes along the opponent axes (JND Sec. 3.3).
    fn dkl_axes(&self, color: DVec3) -> DVec3 {
        let linear = match self.space {
            ColorSpace::Srgb => linear_from_srgb(color),
            ColorSpace::Linear => color,
        };
        let inverse = dkl_from_linear().inverse();
        let g = inverse.transpose() * metric_linear(linear) * inverse;
        DVec3::new(g.x_axis.x, g.y_axis.y, g.z_axis.z)
    }

    fn lab(&self, color: DVec3) -> DVec3 {
        let color = color.clamp(DVec3::ZERO, DVec3::ONE);
        match self.space {
            ColorSpace::Srgb => lab_from_srgb(color),
            ColorSpace::Linear => lab_from_linear(color),
        }
    }

    /// Whether every corner of the cube of side `t` is within one JND of what is shown.
    fn is_within(&self, color: DVec3, t: f64) -> bool {
        let middle = match self.region {
            Region::Corner => 0.0,
            Region::Centred => 0.5 * t,
        };
        let shown = self.lab(color + middle);
        // Clamping bends the directions, so that the quadratic model of a corner says nothing about it.
        let metric = (self.jnd_de <= 1.0 && color.max_element() + t <= 1.0).then(|| self.metric(color));
        corners().all(|v| {
            let is_far = metric.is_some_and(|g| self.corner_limit(g, v) > QUADRATIC_MARGIN * t);
            is_far || delta_e(shown, self.lab(color + t * v)) <= self.jnd_de
        })
    }

    /// The largest t up to 1 such that the cubes of side t and smaller are within one JND, by bisection.
    fn exact_limit(&self, color: DVec3) -> f64 {
        let mut low = 0.5 * self.quadratic_limit(color).min(1.0);
        while !self.is_within(color, low) {
            low *= 0.5;
        }
        self.exact_limit_above(color, low)
    }

    /// [`Observer::exact_limit`], known to be at least `low`.
    fn exact_limit_above(&self, color: DVec3, mut low: f64) -> f64 {
        let mut high = low;
        loop {
            high = (high * 1.1).min(1.0);
            if !self.is_within(color, high) {
                break;
            }
            if high == 1.0 {
                return 1.0;
            }
            low = high;
        }
        while high - low > 1e-9 * low {
            let middle = 0.5 * (low + high);
            if self.is_within(color, middle) {
                low = middle;
            } else {
                high = middle;
            }
        }
        low
    }

    /// The smallest limit over `colors`; 1 or more where there is no limit.
    pub fn smallest_limit(&self, colors: impl Iterator<Item = DVec3> + Clone) -> f64 {
        if self.rule != Rule::Exact {
            return colors.map(|c| self.limit(c)).fold(f64::INFINITY, f64::min);
        }
        // Only a colour whose cube of the smallest side so far is seen has a smaller one. Starting at the colour that is
        // the first by the quadratic model, few of them are ever bisected.
        let by_metric: Vec<(f64, DVec3)> = colors.map(|c| (self.quadratic_limit(c), c)).collect();
        let Some(&(_, first)) = by_metric.iter().min_by(|a, b| a.0.total_cmp(&b.0)) else { return f64::INFINITY };
        let margin = if self.jnd_de <= 1.0 { QUADRATIC_MARGIN } else { f64::INFINITY };
        let mut smallest = self.exact_limit(first);
        for (limit, color) in by_metric {
            if limit <= margin * smallest && !self.is_within(color, smallest) {
                smallest = self.exact_limit(color);
            }
        }
        smallest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn observer(rule: Rule, region: Region) -> Observer {
        Observer { rule, space: ColorSpace::Srgb, region, jnd_de: 1.0 }
    }

    fn colors() -> impl Iterator<Item = DVec3> + Clone {
        (0..125_u32).map(|i| DVec3::new(f64::from(i / 25), f64::from(i / 5 % 5), f64::from(i % 5)) / 4.0)
    }

    #[test]
    fn the_centred_cube_is_up_to_twice_as_large() {
        let (corner, centred) = (observer(Rule::Vertex, Region::Corner), observer(Rule::Vertex, Region::Centred));
        for color in colors() {
            let ratio = centred.limit(color) / corner.limit(color);
            assert!((1.0 - 1e-12..=2.0 + 1e-12).contains(&ratio), "{color}: {ratio}");
        }
    }

    #[test]
    fn every_corner_of_a_smaller_exact_cube_is_within_one_jnd_and_none_larger() {
        for region in [Region::Corner, Region::Centred] {
            let o = observer(Rule::Exact, region);
            for color in colors() {
                let limit = o.limit(color);
                let worst = |t: f64| {
                    let middle = if region == Region::Centred { 0.5 * t } else { 0.0 };
                    let all = corners().map(|v| delta_e(o.lab(color + middle), o.lab(color + t * v)));
                    all.fold(0.0, f64::max)
                };
                for part in 1..=100 {
                    let found = worst(limit * f64::from(part) / 100.0);
                    assert!(found <= 1.0 + 1e-9, "{region:?} {color}: ΔE {found} at {part} %");
                }
                assert!(limit == 1.0 || worst(limit * 1.001) > 1.0, "{region:?} {color}: {limit} is not the largest");
            }
        }
    }

    #[test]
    fn limits_grow_with_the_just_noticeable_difference() {
        for rule in [Rule::Vertex, Rule::DklDiagonal, Rule::DklVertex] {
            let one = observer(rule, Region::Corner);
            let two = Observer { jnd_de: 2.0, ..one };
            for color in colors() {
                assert!((two.limit(color) / one.limit(color) - 2.0).abs() < 1e-12);
            }
        }
        let one = observer(Rule::Exact, Region::Corner);
        let two = Observer { jnd_de: 2.0, ..one };
        assert!(colors().all(|c| two.limit(c) >= one.limit(c)));
    }

    /// Neither the order nor the margin may leave the smallest one out.
    #[test]
    fn the_smallest_exact_limit_is_the_smallest_of_all() {
        for region in [Region::Corner, Region::Centred] {
            for jnd_de in [0.5, 1.0, 3.0] {
                let o = Observer { jnd_de, ..observer(Rule::Exact, region) };
                for corner in
                    [DVec3::ZERO, DVec3::splat(0.875), DVec3::new(0.0, 0.5, 0.875), DVec3::new(0.875, 0.0, 0.0)]
                {
                    let voxel = colors().map(move |c| corner + 0.125 * c);
                    let each = voxel.clone().map(|c| o.limit(c)).fold(f64::INFINITY, f64::min);
                    let found = o.smallest_limit(voxel);
                    assert!((found / each - 1.0).abs() < 1e-8, "{region:?} {jnd_de} {corner}: {found}, {each}");
                }
            }
        }
    }
}
