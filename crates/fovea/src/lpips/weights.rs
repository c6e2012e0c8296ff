//! The safetensors file with the weights of LPIPS: a tensor under any of the names it goes by, checked.

use crate::error::{Error, Result};
use safetensors::{Dtype, SafeTensors};
use std::path::{Path, PathBuf};

const HINT: &str =
    "make the file from the state dict of `lpips.LPIPS(net=\"vgg\")` as the section on LPIPS of README.md shows";

/// The file, in memory.
pub(super) struct WeightsFile {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl WeightsFile {
    /// Reads the file.
    ///
    /// # Errors
    /// [`Error::File`] when it cannot be read or is no safetensors file.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(|error| Error::File {
            path: path.to_owned(),
            message: format!("the weights of LPIPS cannot be read: {error}"),
            hint: "give the file with `--lpips-weights FILE`, or unset `eval.lpips_weights`",
        })?;
        let file = Self { path: path.to_owned(), bytes };
        file.tensors().map(drop)?;
        Ok(file)
    }

    /// The kernel of the convolution that goes by one of `names`, from `num_in` channels, and its shape
    /// `[out, num_in, 3, 3]`.
    ///
    /// # Errors
    /// [`Error::File`].
    pub fn conv(&self, names: &[String], num_in: usize) -> Result<(Vec<f32>, [usize; 4])> {
        let names: Vec<String> = names.iter().map(|name| format!("{name}.weight")).collect();
        let (name, shape, values) = self.tensor(&names)?;
        match shape[..] {
            [num_out, found, 3, 3] if found == num_in && num_out > 0 => Ok((values, [num_out, num_in, 3, 3])),
            _ => Err(self.wrong(format!("`{name}` has the shape {shape:?}, expected [N, {num_in}, 3, 3]"))),
        }
    }

    /// The values of the tensor that goes by one of `names`, of that shape.
    ///
    /// # Errors
    /// [`Error::File`].
    pub fn vector(&self, names: &[String], expected: &[usize]) -> Result<Vec<f32>> {
        let (name, shape, values) = self.tensor(names)?;
        if shape != expected {
            return Err(self.wrong(format!("`{name}` has the shape {shape:?}, expected {expected:?}")));
        }
        Ok(values)
    }

    /// Refuses negative weights of channels: with them different images could be nearer than equal ones.
    ///
    /// # Errors
    /// [`Error::File`].
    pub fn check_not_negative(&self, names: &[String], values: &[f32]) -> Result<()> {
        match values.iter().find(|v| **v < 0.0) {
            Some(value) => Err(self.wrong(format!("`{}` has the value {value}, expected none below 0", names[0]))),
            None => Ok(()),
        }
    }

    fn tensors(&self) -> Result<SafeTensors<'_>> {
        SafeTensors::deserialize(&self.bytes).map_err(|error| self.wrong(format!("no safetensors file: {error}")))
    }

    /// Name, shape and values of the first of `names` that is there.
    fn tensor(&self, names: &[String]) -> Result<(String, Vec<usize>, Vec<f32>)> {
        let tensors = self.tensors()?;
        let Some((name, view)) = names.iter().find_map(|name| Some((name, tensors.tensor(name).ok()?))) else {
            let others = names[1..].iter().map(|name| format!(", or `{name}`")).collect::<String>();
            return Err(self.wrong(format!("the tensor `{}` is missing{others}", names[0])));
        };
        if view.dtype() != Dtype::F32 {
            return Err(self.wrong(format!("`{name}` holds {:?}, expected F32", view.dtype())));
        }
        let values: Vec<f32> =
            view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        match values.iter().position(|v| !v.is_finite()) {
            Some(at) => Err(self.wrong(format!("value {at} of `{name}` is {}, expected finite numbers", values[at]))),
            None => Ok((name.clone(), view.shape().to_vec(), values)),
        }
    }

    fn wrong(&self, message: String) -> Error {
        Error::File { path: self.path.clone(), message, hint: HINT }
    }
}
