//! The fast path: all-float little-endian rows, scattered from and gathered into large blocks in parallel.

use super::UnusableRow;
use super::attributes::{Attributes, RowMut};
use super::header::Header;
use crate::error::Result;
use crate::gaussian_cloud::GaussianCloud;
use crate::sh;
use rayon::prelude::*;
use std::io::Write;
use std::path::Path;

/// Rows handed to a thread at once: about 1 MB of degree 3, large against the cost of a task, small against the caches.
const ROWS_PER_TASK: usize = 4096;

/// Rows gathered before they are written: about 16 MB of degree 3. The next block is gathered while one is written.
const ROWS_PER_BLOCK: usize = 65_536;

/// Reads the vertex rows after `header`. Unusable rows are in the cloud and listed beside it, in order.
pub(super) fn read(
    path: &Path,
    bytes: &[u8],
    header: &Header,
    attributes: &Attributes,
) -> Result<(GaussianCloud, Vec<UnusableRow>)> {
    let n = header.vertex.count;
    let row_bytes = 4 * header.vertex.properties.len();
    let data = &bytes[header.data_offset..];
    let Some(data) = n.checked_mul(row_bytes).and_then(|size| data.get(..size)) else {
        return Err(header.truncated(path, data.len() / row_bytes));
    };
    let mut cloud = GaussianCloud::zeros(n, attributes.sh_degree);
    let k = cloud.num_coefficients();
    let unusable: Vec<Vec<UnusableRow>> = (
        cloud.means.par_chunks_mut(ROWS_PER_TASK),
        cloud.quats.par_chunks_mut(ROWS_PER_TASK),
        cloud.log_scales.par_chunks_mut(ROWS_PER_TASK),
        cloud.opacity_logits.par_chunks_mut(ROWS_PER_TASK),
        cloud.sh.par_chunks_mut(ROWS_PER_TASK * k),
        data.par_chunks(ROWS_PER_TASK * row_bytes),
    )
        .into_par_iter()
        .enumerate()
        .map(|(task, (means, quats, log_scales, opacity_logits, sh, rows))| {
            let mut unusable = Vec::new();
            let mut sh = sh.chunks_exact_mut(k);
            for (i, row) in rows.chunks_exact(row_bytes).enumerate() {
                // A cast to bytes-of-four has no alignment to violate: headers end at any offset.
                let row: &[[u8; 4]] = bytemuck::cast_slice(row);
                let place = RowMut {
                    mean: &mut means[i],
                    quat: &mut quats[i],
                    log_scale: &mut log_scales[i],
                    opacity_logit: &mut opacity_logits[i],
                    sh: sh.next().expect("as many SH rows as vertex rows"),
                };
                let state = attributes.scatter(|column| f32::from_le_bytes(row[column]), place);
                unusable.extend(UnusableRow::check(task * ROWS_PER_TASK + i, state));
            }
            unusable
        })
        .collect();
    Ok((cloud, unusable.concat()))
}

/// Writes header and rows of `cloud` in the 3DGS order, with `comments` in the header.
pub(super) fn write(file: &mut impl Write, cloud: &GaussianCloud, comments: &[String]) -> std::io::Result<()> {
    file.write_all(header_text(cloud.len(), cloud.sh_degree, comments).as_bytes())?;
    let n = cloud.len();
    let mut ready = gathered(cloud, 0, n.min(ROWS_PER_BLOCK));
    let mut next_row = n.min(ROWS_PER_BLOCK);
    while !ready.is_empty() {
        let end = n.min(next_row + ROWS_PER_BLOCK);
        // The writer need not be `Send`: the scope runs it on this thread and the gathering beside it.
        let (written, gathered_next) = std::thread::scope(|scope| {
            let gathering = (next_row < end).then(|| scope.spawn(|| gathered(cloud, next_row, end)));
            let written = file.write_all(&ready);
            let next = gathering.map(|handle| handle.join().expect("gathering rows does not panic"));
            (written, next.unwrap_or_default())
        });
        written?;
        ready = gathered_next;
        next_row = end;
    }
    Ok(())
}

/// The PLY header of `num_gaussians` rows of SH `degree`, in the order of the 3DGS reference implementation.
pub(super) fn header_text(num_gaussians: usize, degree: u32, comments: &[String]) -> String {
    let mut text = start_of_header(comments);
    text.push_str(&format!("element vertex {num_gaussians}\n"));
    let mut property = |name: &str| text.push_str(&format!("property float {name}\n"));
    ["x", "y", "z", "nx", "ny", "nz"].into_iter().for_each(&mut property);
    (0..3).for_each(|i| property(&format!("f_dc_{i}")));
    (0..sh::num_rest(degree)).for_each(|i| property(&format!("f_rest_{i}")));
    property("opacity");
    (0..3).for_each(|i| property(&format!("scale_{i}")));
    (0..4).for_each(|i| property(&format!("rot_{i}")));
    text.push_str("end_header\n");
    text
}

/// The lines before the first element.
pub(super) fn start_of_header(comments: &[String]) -> String {
    let mut text = "ply\nformat binary_little_endian 1.0\n".to_owned();
    for comment in comments {
        let printable = |c: char| if c.is_ascii_graphic() || c == ' ' { c } else { '?' };
        // Readers that search for the end of the header instead of parsing it must not find it here.
        let line = comment.chars().map(printable).collect::<String>().replace("end_header", "end header");
        text.push_str(&format!("comment {}\n", line.trim()));
    }
    text
}

/// Rows `start..end` of `cloud` as they stand in the file.
fn gathered(cloud: &GaussianCloud, start: usize, end: usize) -> Vec<u8> {
    let k = cloud.num_coefficients();
    let row_bytes = 4 * (14 + 3 * k);
    let mut block = vec![0u8; (end - start) * row_bytes];
    block.par_chunks_mut(ROWS_PER_TASK * row_bytes).enumerate().for_each(|(task, rows)| {
        let first = start + task * ROWS_PER_TASK;
        for (i, row) in rows.chunks_exact_mut(row_bytes).enumerate() {
            gather_row(cloud, first + i, k, bytemuck::cast_slice_mut(row));
        }
    });
    block
}

/// One row: mean, zero normal, DC, the other coefficients channel by channel, opacity, scales, quaternion.
#[inline(always)]
fn gather_row(cloud: &GaussianCloud, index: usize, k: usize, row: &mut [[u8; 4]]) {
    let sh = &cloud.sh[index * k..(index + 1) * k];
    let (head, tail) = row.split_at_mut(9);
    let (rest, tail) = tail.split_at_mut(3 * (k - 1));
    let put = |to: &mut [[u8; 4]], from: &[f32]| to.iter_mut().zip(from).for_each(|(t, f)| *t = f.to_le_bytes());
    put(&mut head[0..3], &cloud.means[index]);
    put(&mut head[6..9], &sh[0]);
    let (red, others) = rest.split_at_mut(k - 1);
    let (green, blue) = others.split_at_mut(k - 1);
    for (((coefficient, r), g), b) in sh[1..].iter().zip(red).zip(green).zip(blue) {
        (*r, *g, *b) = (coefficient[0].to_le_bytes(), coefficient[1].to_le_bytes(), coefficient[2].to_le_bytes());
    }
    tail[0] = cloud.opacity_logits[index].to_le_bytes();
    put(&mut tail[1..4], &cloud.log_scales[index]);
    put(&mut tail[4..8], &cloud.quats[index]);
}
