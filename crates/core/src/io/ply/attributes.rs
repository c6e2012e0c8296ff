//! Which column of a vertex row holds which attribute of a Gaussian, and how one row becomes one.

use super::UnusableRow;
use super::header::{Header, list_or_none};
use crate::error::{Error, Result};
use crate::gaussian_cloud::GaussianCloud;
use crate::sh;
use std::path::Path;

/// Columns of a vertex row, by attribute.
pub(super) struct Attributes {
    means: [usize; 3],
    quats: [usize; 4],
    log_scales: [usize; 3],
    opacity_logit: usize,
    /// `[K]`: columns of R, G, B of each coefficient.
    sh: Vec<[usize; 3]>,
    /// SH degree that the number of `f_rest` properties means.
    pub sh_degree: u32,
}

impl Attributes {
    /// Finds the columns of a 3DGS model, or says which are missing.
    pub fn of_gaussians(path: &Path, header: &Header) -> Result<Self> {
        let mut missing = Vec::new();
        let mut find = |name: String| {
            header.column(&name).unwrap_or_else(|| {
                missing.push(name);
                0
            })
        };
        let means = ["x", "y", "z"].map(|name| find(name.into()));
        let dc = [0, 1, 2].map(|i| find(format!("f_dc_{i}")));
        let opacity_logit = find("opacity".into());
        let log_scales = [0, 1, 2].map(|i| find(format!("scale_{i}")));
        let quats = [0, 1, 2, 3].map(|i| find(format!("rot_{i}")));

        let num_rest = header.vertex.properties.keys().filter(|name| name.starts_with("f_rest_")).count();
        let rest: Vec<usize> = (0..num_rest).map(|i| find(format!("f_rest_{i}"))).collect();
        if !missing.is_empty() {
            return Err(missing_attributes(path, header, &missing));
        }
        let Some(sh_degree) = sh::degree_from_rest(num_rest) else {
            return Err(Error::format(
                path,
                format!("found {num_rest} f_rest properties, expected 0, 9, 24, 45 or 72 (SH degree 0 to 4)"),
                "export the model with complete spherical harmonics of one degree",
            ));
        };
        let per_channel = num_rest / 3;
        let channels = |j: usize| [rest[j], rest[per_channel + j], rest[2 * per_channel + j]];
        let sh = std::iter::once(dc).chain((0..per_channel).map(channels)).collect();
        Ok(Self { means, quats, log_scales, opacity_logit, sh, sh_degree })
    }

    /// Moves one row into its place; `at` gives the value of a column. Returns whether all values are finite and whether
    /// the quaternion is a rotation.
    #[inline(always)]
    pub fn scatter(&self, at: impl Fn(usize) -> f32, row: RowMut<'_>) -> (bool, bool) {
        *row.mean = self.means.map(&at);
        *row.quat = self.quats.map(&at);
        *row.log_scale = self.log_scales.map(&at);
        *row.opacity_logit = at(self.opacity_logit);
        // An exponent of all ones is NaN or infinity; the OR over all values keeps the loop free of branches.
        let mut special = u32::from(!row.opacity_logit.is_finite());
        for (coefficient, columns) in row.sh.iter_mut().zip(&self.sh) {
            *coefficient = columns.map(&at);
            special |= coefficient.iter().fold(0, |bits, v| bits | u32::from(!v.is_finite()));
        }
        for v in row.mean.iter().chain(row.quat.iter()).chain(row.log_scale.iter()) {
            special |= u32::from(!v.is_finite());
        }
        (special == 0, *row.quat != [0.0; 4])
    }
}

/// The place of one Gaussian in a cloud.
pub(super) struct RowMut<'a> {
    pub mean: &'a mut [f32; 3],
    pub quat: &'a mut [f32; 4],
    pub log_scale: &'a mut [f32; 3],
    pub opacity_logit: &'a mut f32,
    /// `[K]` coefficients.
    pub sh: &'a mut [[f32; 3]],
}

impl<'a> RowMut<'a> {
    /// Row `index` of `cloud`.
    pub fn of(cloud: &'a mut GaussianCloud, index: usize) -> Self {
        let k = cloud.num_coefficients();
        Self {
            mean: &mut cloud.means[index],
            quat: &mut cloud.quats[index],
            log_scale: &mut cloud.log_scales[index],
            opacity_logit: &mut cloud.opacity_logits[index],
            sh: &mut cloud.sh[index * k..(index + 1) * k],
        }
    }
}

impl UnusableRow {
    /// What is wrong with row `index`, given the result of [`Attributes::scatter`].
    pub fn check(index: usize, (is_finite, is_rotation): (bool, bool)) -> Option<Self> {
        (!(is_finite && is_rotation)).then_some(Self { index, is_finite })
    }
}

fn missing_attributes(path: &Path, header: &Header, missing: &[String]) -> Error {
    let found: Vec<String> = header.vertex.properties.keys().cloned().collect();
    let is_missing = |name: &str| missing.iter().any(|m| m == name);
    let hint = if is_missing("f_dc_0") && is_missing("opacity") && !is_missing("x") {
        "this is a point cloud or mesh, not a Gaussian model: train one from its scene first"
    } else if missing == ["scale_2"] {
        "this looks like a 2D Gaussian (surfel) model; models need three scales"
    } else {
        "export the model in the 3DGS PLY layout"
    };
    let message = format!("vertex attributes missing: {}; found: {}", missing.join(", "), shortened(&found));
    Error::format(path, message, hint)
}

/// Property names for a message: a model has dozens.
fn shortened(names: &[String]) -> String {
    const SHOWN: usize = 12;
    match names.len().checked_sub(SHOWN) {
        Some(more) if more > 0 => format!("{}, … ({more} more)", list_or_none(&names[..SHOWN])),
        _ => list_or_none(names),
    }
}
