//! What a Gaussian may not exceed: beyond these bounds it is broken, and viewers fail on it or draw nothing.

use crate::event::BrokenCounts;

/// A standard deviation beyond this many scene extents is broken, not large: skies need less than ten.
const MAX_SCALE_EXTENTS: f32 = 100.0;
/// A centre beyond this many scene extents from the origin of the scene is lost: no view can resolve its parallax.
const MAX_DISTANCE_EXTENTS: f32 = 1e4;

/// The bounds of a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Middle of the scene, world units.
    pub center: [f32; 3],
    /// Largest log scale.
    pub max_log_scale: f32,
    /// Largest distance from the centre along an axis, world units.
    pub max_distance: f32,
}

impl Bounds {
    /// The bounds of a scene of radius `extent` around `center`, world units.
    pub fn of_scene(center: [f32; 3], extent: f32) -> Self {
        Self { center, max_log_scale: (MAX_SCALE_EXTENTS * extent).ln(), max_distance: MAX_DISTANCE_EXTENTS * extent }
    }

    /// What is wrong with a Gaussian of these values, all of which are finite or not as `is_finite` says.
    pub fn judge(&self, is_finite: bool, log_scales: &[f32], mean: &[f32]) -> Option<Broken> {
        if !is_finite {
            return Some(Broken::NonFinite);
        }
        if log_scales.iter().any(|s| *s > self.max_log_scale) {
            return Some(Broken::Huge);
        }
        mean.iter().zip(self.center).any(|(x, c)| (x - c).abs() > self.max_distance).then_some(Broken::Far)
    }
}

/// Why a Gaussian is broken. The numbers are those of the kernels, where 0 is sound.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Broken {
    /// A value is not finite.
    NonFinite = 1,
    /// Larger than the bounds.
    Huge = 2,
    /// Farther than the bounds.
    Far = 3,
}

impl Broken {
    /// The reason of that number; `None` for 0.
    pub fn from_word(word: u32) -> Option<Self> {
        match word {
            0 => None,
            1 => Some(Self::NonFinite),
            2 => Some(Self::Huge),
            _ => Some(Self::Far),
        }
    }
}

impl FromIterator<Broken> for BrokenCounts {
    fn from_iter<I: IntoIterator<Item = Broken>>(reasons: I) -> Self {
        let mut counts = Self::default();
        for reason in reasons {
            match reason {
                Broken::NonFinite => counts.non_finite += 1,
                Broken::Huge => counts.huge += 1,
                Broken::Far => counts.far += 1,
            }
        }
        counts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gaussian_is_counted_once_under_the_first_reason() {
        let bounds = Bounds::of_scene([1.0, 0.0, 0.0], 2.0);
        let judge = |is_finite, log_scale: f32, x: f32| bounds.judge(is_finite, &[0.0, log_scale, 0.0], &[x, 0.0, 0.0]);
        let (huge, far) = (200.1f32.ln(), 2.0002e4);
        assert_eq!(judge(true, 199.9f32.ln(), 1.9e4), None);
        assert_eq!(judge(false, huge, far), Some(Broken::NonFinite));
        assert_eq!(judge(true, huge, far), Some(Broken::Huge));
        assert_eq!(judge(true, 0.0, far), Some(Broken::Far));
        assert_eq!(judge(true, 0.0, -far), Some(Broken::Far));
        let counts: BrokenCounts = [Broken::Far, Broken::Huge, Broken::Far].into_iter().collect();
        assert_eq!((counts, counts.total()), (BrokenCounts { non_finite: 0, huge: 1, far: 2 }, 3));
        assert_eq!(counts.to_string(), "1 huge, 2 far away");
    }
}
