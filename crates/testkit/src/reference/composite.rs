//! Compositing of a frame, float64: tile lists, per-pixel loops, counters.

use super::{ALPHA_MIN, Camera, Cutoff, Frame, Gaussians, Options, Projected, TILE, Table, TableResidual, project};

/// Renders the view and counts its work.
pub fn render(gaussians: &Gaussians, camera: &Camera, options: &Options) -> Frame {
    let mut visible: Vec<Projected> =
        (0..gaussians.len()).filter_map(|i| project(gaussians, i, camera, options)).collect();
    // Front to back, ties by index (the sort is stable).
    visible.sort_by(|a, b| a.depth.total_cmp(&b.depth));

    let num_pixels = camera.width * camera.height;
    let mut frame = Frame {
        color: vec![[0.0; 3]; num_pixels],
        alpha: vec![0.0; num_pixels],
        depth: vec![0.0; num_pixels],
        num_blended: vec![0; num_pixels],
        fragile: vec![false; num_pixels],
        counters: vec![Default::default(); gaussians.len()],
        ..Frame::default()
    };
    let mut has_pair = vec![false; gaussians.len()];
    for tile_y in 0..camera.height.div_ceil(TILE) {
        for tile_x in 0..camera.width.div_ceil(TILE) {
            render_tile(&mut frame, &visible, camera, options, tile_x, tile_y);
            for &i in frame.tile_lists.last().expect("render_tile pushes its list") {
                has_pair[i as usize] = true;
            }
        }
    }
    let totals = &mut frame.totals;
    totals.num_visible = has_pair.iter().filter(|&&p| p).count() as u64;
    totals.num_tiles = frame.tile_lists.len() as u64;
    totals.num_tiles_empty = frame.tile_lists.iter().filter(|l| l.is_empty()).count() as u64;
    totals.num_pairs = frame.tile_lists.iter().map(|l| l.len() as u64).sum();
    totals.num_pairs_used = frame.tile_ends.iter().map(|&e| u64::from(e)).sum();
    totals.num_blended = frame.num_blended.iter().map(|&n| u64::from(n)).sum();
    frame
}

/// −½ dᵀ conic d at offset d.
fn power(p: &Projected, dx: f64, dy: f64) -> f64 {
    -0.5 * (p.conic[0] * dx * dx + p.conic[2] * dy * dy) - p.conic[1] * dx * dy
}

/// Largest value of the Gaussian over the rectangle [x0, x1] × [y0, y1] (exponent only): 0 inside, else on an edge, where
/// the quadratic is a parabola.
fn largest_power(p: &Projected, x: [f64; 2], y: [f64; 2]) -> f64 {
    let [cx, cy] = p.mean2d;
    if (x[0]..=x[1]).contains(&cx) && (y[0]..=y[1]).contains(&cy) {
        return 0.0;
    }
    let [a, b, c] = p.conic;
    let mut best = f64::NEG_INFINITY;
    for edge in x {
        let dx = edge - cx;
        let dy = (-b * dx / c).clamp(y[0] - cy, y[1] - cy);
        best = best.max(power(p, dx, dy));
    }
    for edge in y {
        let dy = edge - cy;
        let dx = (-b * dy / a).clamp(x[0] - cx, x[1] - cx);
        best = best.max(power(p, dx, dy));
    }
    best
}

fn near(value: f64, threshold: f64, relative: f64) -> bool {
    (value / threshold - 1.0).abs() < relative
}

fn render_tile(
    frame: &mut Frame,
    visible: &[Projected],
    camera: &Camera,
    options: &Options,
    tile_x: usize,
    tile_y: usize,
) {
    let span = |tile: usize, size: usize| {
        let (low, high) = (TILE * tile, (TILE * (tile + 1)).min(size));
        ([low as f64 + 0.5, high as f64 - 0.5], low..high)
    };
    let (x_centers, columns) = span(tile_x, camera.width);
    let (y_centers, rows) = span(tile_y, camera.height);

    // The pair exists iff the largest α over the pixel centres' rectangle reaches 1/255.
    let (mut list, mut reached) = (Vec::<&Projected>::new(), Vec::<(u32, bool)>::new());
    for p in visible {
        let largest = p.opacity * largest_power(p, x_centers, y_centers).exp();
        let fragile = near(largest, ALPHA_MIN, options.fragile_rel);
        frame.totals.fragile_pairs += u64::from(fragile);
        if largest >= ALPHA_MIN || options.cutoff == Cutoff::None {
            list.push(p);
        }
        if fragile || largest >= ALPHA_MIN {
            reached.push((p.index, fragile));
        }
    }

    let channels = list.iter().flat_map(|p| p.color).chain(options.background);
    let color_max = match &options.table {
        Some(table) if table.is_tile_bound => channels.fold(1.0, f64::max),
        _ => 1.0,
    };
    let mut end = 0;
    let mut any_fragile = false;
    let mut blended_here = vec![false; list.len()];
    for row in rows {
        for column in columns.clone() {
            let pixel = row * camera.width + column;
            let center = [column as f64 + 0.5, row as f64 + 0.5];
            let stop = render_pixel(frame, &list, options, color_max, pixel, center, &mut blended_here);
            end = end.max(stop);
            any_fragile |= frame.fragile[pixel];
        }
    }
    for (position, (p, blended)) in list.iter().zip(blended_here).enumerate() {
        let counters = &mut frame.counters[p.index as usize];
        counters.tiles_used += u32::from(position < end);
        counters.tiles_blended += u32::from(blended);
    }
    for (index, fragile) in reached {
        frame.counters[index as usize].slack_tiles += u32::from(fragile || any_fragile);
    }
    frame.tile_lists.push(list.iter().map(|p| p.index).collect());
    frame.tile_ends.push(u32::try_from(end).expect("lists of tests are short"));
}

/// Blends one pixel; returns the list position at which it stopped, or the length of the list.
fn render_pixel(
    frame: &mut Frame,
    list: &[&Projected],
    options: &Options,
    color_max: f64,
    pixel: usize,
    center: [f64; 2],
    blended_here: &mut [bool],
) -> usize {
    let mut transmittance = 1.0;
    let mut stop = list.len();
    let mut weights: Vec<(u32, f64)> = Vec::new();
    let mut reached = Vec::new();
    let mut fragile = false;
    let (mut color, mut depth) = ([0.0; 3], 0.0);
    for (position, p) in list.iter().enumerate() {
        let raw = p.opacity * power(p, center[0] - p.mean2d[0], center[1] - p.mean2d[1]).exp();
        if options.cutoff == Cutoff::Hard {
            if raw >= ALPHA_MIN * (1.0 - options.fragile_rel) {
                reached.push(p.index);
                fragile |=
                    near(raw, ALPHA_MIN, options.fragile_rel) || near(raw, options.alpha_max, options.fragile_rel);
            }
            if raw < ALPHA_MIN {
                continue;
            }
        }
        let alpha = raw.min(options.alpha_max);
        let next = transmittance * (1.0 - alpha);
        fragile |= near(next, options.stop, 10.0 * options.fragile_rel);
        let (is_below, is_near) = match &options.table {
            Some(table) => ask(table, transmittance * color_max, color, options.fragile_rel),
            None => (false, false),
        };
        fragile |= is_near;
        if next <= options.stop || is_below {
            stop = position;
            break;
        }
        let weight = transmittance * alpha;
        for (sum, c) in color.iter_mut().zip(p.color) {
            *sum += weight * c;
        }
        depth += weight * p.depth;
        weights.push((p.index, weight));
        blended_here[position] = true;
        transmittance = next;
    }
    let residual = match &options.table {
        Some(table) if stop < list.len() => table.residual,
        _ => TableResidual::Background,
    };
    for (sum, b) in color.iter_mut().zip(options.background) {
        *sum += transmittance
            * match residual {
                TableResidual::Drop => 0.0,
                TableResidual::Background => b,
                TableResidual::Mean if transmittance == 1.0 => 0.0,
                TableResidual::Mean => *sum / (1.0 - transmittance),
                TableResidual::Centre => color_max / 2.0,
            };
    }
    (frame.color[pixel], frame.alpha[pixel], frame.depth[pixel]) = (color, 1.0 - transmittance, depth);
    frame.num_blended[pixel] = u32::try_from(weights.len()).expect("lists of tests are short");
    frame.fragile[pixel] = fragile;
    count(frame, &weights, &reached, fragile);
    stop
}

/// Whether a table stops a pixel of this colour with `left` = T·c_max, and whether float32 may decide otherwise.
fn ask(table: &Table, left: f64, color: [f64; 3], fragile_rel: f64) -> (bool, bool) {
    let largest = table.limits.iter().copied().fold(0.0, f64::max);
    if left > largest * (1.0 + 10.0 * fragile_rel) {
        return (false, false);
    }
    let size = table.size as f64;
    let (mut at, mut is_near) = (0, false);
    for channel in color {
        let place = channel * size;
        // Below 0 and above 1 there is no border.
        is_near |= (place - place.round()).abs() < fragile_rel * size && place.round() > 0.0 && place.round() < size;
        at = at * table.size + (place.clamp(0.0, size - 1.0)) as usize;
    }
    (left <= table.limits[at], is_near || near(left, table.limits[at], 10.0 * fragile_rel))
}

fn count(frame: &mut Frame, weights: &[(u32, f64)], reached: &[u32], fragile: bool) {
    let mut best: Option<(u32, f64)> = None;
    for &(index, weight) in weights {
        let counters = &mut frame.counters[index as usize];
        counters.pixels_blended += 1;
        counters.weight_max = counters.weight_max.max(weight);
        counters.weight_sum += weight;
        if best.is_none_or(|(_, w)| weight > w) {
            best = Some((index, weight));
        }
    }
    let mut tied = false;
    if let Some((winner, weight)) = best {
        frame.counters[winner as usize].pixels_dominated += 1;
        tied = weights.iter().any(|&(i, w)| i != winner && near(w, weight, 1e-4));
    }
    for &index in reached {
        let counters = &mut frame.counters[index as usize];
        counters.slack_pixels += u32::from(fragile);
        counters.slack_dominated += u32::from(fragile || tied);
    }
}
