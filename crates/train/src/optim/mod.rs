//! The optimiser: a model in training, its parameters as rows on the host, learning-rate schedules.

pub mod adam;
pub mod missed;
pub mod schedule;
pub mod state;

pub use adam::{AdamSettings, Regularizers};
pub use schedule::LearningRates;
pub use state::lag::{SeenBy, ShRates};
pub use state::{HostState, ModelState, Snapshot};

use crate::error::Result;
use crate::host::read;
use burn::tensor::{Device, Tensor, TensorData};
use gazesplat_core::GaussianCloud;
use gazesplat_render::Splats;

/// A parameter tensor of the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Group {
    /// Centres, rows of 3.
    Means,
    /// Rotations (w, x, y, z), rows of 4.
    Quats,
    /// Logarithms of the standard deviations, rows of 3.
    LogScales,
    /// Logits of the opacities, rows of 1.
    OpacityLogits,
    /// SH coefficients, rows of K · 3.
    Sh,
}

impl Group {
    /// All groups, in the order of [`Columns`].
    pub const ALL: [Self; 5] = [Self::Means, Self::Quats, Self::LogScales, Self::OpacityLogits, Self::Sh];

    /// Name of the tensor in [`Splats`].
    pub fn name(self) -> &'static str {
        match self {
            Self::Means => "means",
            Self::Quats => "quats",
            Self::LogScales => "log_scales",
            Self::OpacityLogits => "opacity_logits",
            Self::Sh => "sh",
        }
    }
}

/// One host vector per [`Group`], N rows each: the parameters, their gradients, or their moments.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Columns {
    /// Values in C order, indexed by group.
    pub data: [Vec<f32>; 5],
    /// Row widths, indexed by group.
    pub widths: [usize; 5],
}

impl Columns {
    /// The rows of `cloud`.
    pub fn from_cloud(cloud: &GaussianCloud) -> Self {
        let data = [
            cloud.means.as_flattened().to_vec(),
            cloud.quats.as_flattened().to_vec(),
            cloud.log_scales.as_flattened().to_vec(),
            cloud.opacity_logits.clone(),
            cloud.sh.as_flattened().to_vec(),
        ];
        Self { data, widths: [3, 4, 3, 1, 3 * cloud.num_coefficients()] }
    }

    /// Takes the values out of `splats`; on a CPU without copying them, if no other tensor shares them.
    ///
    /// # Errors
    /// [`crate::Error::Render`] when the device does not answer.
    pub fn from_splats(splats: Splats) -> Result<Self> {
        let [_, num_coefficients, _] = splats.sh.dims();
        let data = [
            read(splats.means)?,
            read(splats.quats)?,
            read(splats.log_scales)?,
            read(splats.opacity_logits)?,
            read(splats.sh)?,
        ];
        Ok(Self { data, widths: [3, 4, 3, 1, 3 * num_coefficients] })
    }

    /// Moves the values into tensors on `device`.
    pub fn into_splats(self, device: &Device) -> Splats {
        let n = self.num_rows();
        let num_coefficients = self.num_coefficients();
        let [means, quats, log_scales, opacity_logits, sh] = self.data;
        Splats {
            means: Tensor::from_data(TensorData::new(means, [n, 3]), device),
            quats: Tensor::from_data(TensorData::new(quats, [n, 4]), device),
            log_scales: Tensor::from_data(TensorData::new(log_scales, [n, 3]), device),
            opacity_logits: Tensor::from_data(TensorData::new(opacity_logits, [n]), device),
            sh: Tensor::from_data(TensorData::new(sh, [n, num_coefficients, 3]), device),
        }
    }

    /// Zeros of the same shape.
    pub fn zeros_like(&self) -> Self {
        Self { data: std::array::from_fn(|g| vec![0.0; self.data[g].len()]), widths: self.widths }
    }

    /// Number of rows N.
    pub fn num_rows(&self) -> usize {
        self.data[Group::OpacityLogits as usize].len()
    }

    /// SH coefficients per row and channel.
    pub fn num_coefficients(&self) -> usize {
        self.widths[Group::Sh as usize] / 3
    }

    /// Values of a group.
    pub fn of(&self, group: Group) -> &[f32] {
        &self.data[group as usize]
    }

    /// Values of a group, for writing.
    pub fn of_mut(&mut self, group: Group) -> &mut Vec<f32> {
        &mut self.data[group as usize]
    }

    /// Row `index` of a group.
    pub fn row(&self, group: Group, index: usize) -> &[f32] {
        let width = self.widths[group as usize];
        &self.data[group as usize][index * width..][..width]
    }

    /// Row `index` of a group, for writing.
    pub fn row_mut(&mut self, group: Group, index: usize) -> &mut [f32] {
        let width = self.widths[group as usize];
        &mut self.data[group as usize][index * width..][..width]
    }

    /// The first row with a value that is not finite, else the one with the largest magnitude: its group and that value.
    pub fn most_suspect(&self) -> Option<(usize, Group, f32)> {
        let in_group = |group: Group| {
            let values = self.of(group);
            let at = values
                .iter()
                .position(|v| !v.is_finite())
                .or_else(|| (0..values.len()).max_by(|&a, &b| values[a].abs().total_cmp(&values[b].abs())))?;
            Some((at / self.widths[group as usize], group, values[at]))
        };
        let candidates: Vec<_> = Group::ALL.into_iter().filter_map(in_group).collect();
        let broken = candidates.iter().filter(|(.., v)| !v.is_finite()).min_by_key(|(row, ..)| *row);
        broken.or_else(|| candidates.iter().max_by(|a, b| a.2.abs().total_cmp(&b.2.abs()))).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn columns() -> Columns {
        let widths = [3, 4, 3, 1, 12];
        Columns { data: widths.map(|w| (0..w * 5).map(|i| i as f32 * 0.1).collect()), widths }
    }

    #[test]
    fn values_move_into_tensors_and_back_without_a_copy() {
        let mut devices = vec![gazesplat_render::cpu_device()];
        #[cfg(feature = "flex")]
        devices.push(gazesplat_render::flex_device());
        for device in devices {
            let columns = columns();
            let (expected, addresses) = (columns.clone(), columns.data.each_ref().map(|d| d.as_ptr()));
            let back = Columns::from_splats(columns.into_splats(&device)).expect("a CPU answers");
            assert_eq!(back, expected);
            assert_eq!(back.data.each_ref().map(|d| d.as_ptr()), addresses);
        }
    }

    #[test]
    fn the_first_broken_row_is_named_before_the_largest() {
        let mut columns = columns();
        columns.row_mut(Group::Quats, 1)[2] = -1e9;
        assert_eq!(columns.most_suspect(), Some((1, Group::Quats, -1e9)));
        columns.row_mut(Group::Sh, 4)[0] = f32::NAN;
        columns.row_mut(Group::LogScales, 3)[0] = f32::INFINITY;
        assert_eq!(columns.most_suspect(), Some((3, Group::LogScales, f32::INFINITY)));
    }
}
