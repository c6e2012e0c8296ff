//! The model as other programs get it.

use super::Trainer;
use crate::densify::{Bounds, Broken};
use crate::error::Result;
use crate::event::BrokenCounts;
use gazesplat_core::GaussianCloud;
use gazesplat_render::Splats;

/// A model for other programs.
#[derive(Debug, Clone, PartialEq)]
pub struct Exported {
    /// The model.
    pub cloud: GaussianCloud,
    /// Gaussians left out, since viewers fail on them; those without a rotation are among the ones that are not finite.
    pub left_out: BrokenCounts,
}

impl Trainer {
    /// The model as it is exported: of the degree of the settings, Gaussians with a non-finite value or beyond the bounds of
    /// the scene left out and counted.
    ///
    /// # Errors
    /// [`crate::Error::Render`] when the device does not answer.
    pub fn export(&self) -> Result<Exported> {
        self.exported(&self.state.current_lent()?)
    }

    /// The model of [`Trainer::export`].
    ///
    /// # Errors
    /// As [`Trainer::export`].
    pub fn to_cloud(&self) -> Result<GaussianCloud> {
        Ok(self.export()?.cloud)
    }

    /// [`Trainer::export`] of another state of the model.
    pub(crate) fn exported(&self, splats: &Splats) -> Result<Exported> {
        let cloud = splats.to_cloud()?;
        let cloud = cloud.with_sh_degree(cloud.sh_degree.max(self.config.model.sh_degree));
        Ok(without_broken(cloud, &Bounds::of_scene(self.center, self.extent)))
    }
}

/// `cloud` without what no viewer can do anything with.
fn without_broken(cloud: GaussianCloud, bounds: &Bounds) -> Exported {
    let judge = |i: usize| bounds.judge(cloud.is_row_valid(i), &cloud.log_scales[i], &cloud.means[i]);
    let verdicts: Vec<Option<Broken>> = (0..cloud.len()).map(judge).collect();
    let sound: Vec<usize> = (0..cloud.len()).filter(|&i| verdicts[i].is_none()).collect();
    let left_out = verdicts.into_iter().flatten().collect();
    let cloud = if sound.len() == cloud.len() { cloud } else { cloud.select(&sound) };
    Exported { cloud, left_out }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_viewers_fail_on_is_left_out_and_counted() {
        let n = 6;
        let mut cloud = GaussianCloud {
            means: (0..n).map(|i| [i as f32, 0.0, 0.0]).collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            log_scales: vec![[-2.0; 3]; n],
            opacity_logits: vec![0.5; n],
            sh_degree: 0,
            sh: vec![[0.1; 3]; n],
        };
        let bounds = Bounds::of_scene([0.0; 3], 1.0);
        let whole = without_broken(cloud.clone(), &bounds);
        assert_eq!(whole, Exported { cloud: cloud.clone(), left_out: BrokenCounts::default() });
        cloud.sh[0][1] = f32::NAN;
        cloud.quats[2] = [0.0; 4];
        cloud.log_scales[3][2] = 101f32.ln();
        cloud.means[5][1] = -1.1e4;
        let Exported { cloud, left_out } = without_broken(cloud, &bounds);
        assert_eq!(left_out, BrokenCounts { non_finite: 2, huge: 1, far: 1 });
        assert_eq!(cloud.means, [[1.0, 0.0, 0.0], [4.0, 0.0, 0.0]]);
    }
}
