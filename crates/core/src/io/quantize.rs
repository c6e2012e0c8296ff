//! What the compact formats share: opacities and rotations in a few bits.
//!
//! A value that is stored in steps of `s` comes back within `s / 2`, if it lies in the range of the format.

/// Opacity of a logit.
pub(super) fn opacity(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// Opacity in 255 steps, halves rounded up.
pub(super) fn opacity_to_u8(logit: f32) -> u8 {
    (opacity(logit) * 255.0 + 0.5) as u8
}

/// The logit of a stored opacity. The ends stand for the opacities that are rounded to them, [0, ½/255] and its mirror
/// image: they become the middles of these ranges, as 0 and 1 have no finite logit.
pub(super) fn logit_from_u8(level: u8) -> f32 {
    let opacity = match level {
        0 => 0.25 / 255.0,
        255 => 254.75 / 255.0,
        level => f32::from(level) / 255.0,
    };
    (opacity / (1.0 - opacity)).ln()
}

/// The quaternion of length 1 in the direction of `quat`; the identity for one that has no direction.
pub(super) fn normalized(quat: [f32; 4]) -> [f32; 4] {
    // Scaled first: squares of very small and very large numbers leave the range of `f32`.
    let largest = quat.iter().fold(0.0_f32, |a, b| a.max(b.abs()));
    if !(largest > 0.0 && largest.is_finite()) {
        return [1.0, 0.0, 0.0, 0.0];
    }
    let scaled = quat.map(|v| v / largest);
    let length = scaled.iter().map(|v| v * v).sum::<f32>().sqrt();
    scaled.map(|v| v / length)
}

/// Index of the component of the largest magnitude, the first of equals, and the other three in order, signs turned so
/// that the largest is positive: the rotation is the same and the largest need not be stored ("smallest three").
pub(super) fn smallest_three(unit: [f32; 4]) -> (usize, [f32; 3]) {
    let largest = (1..4).fold(0, |best, i| if unit[i].abs() > unit[best].abs() { i } else { best });
    let sign = if unit[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut others = unit.iter().enumerate().filter(|(i, _)| *i != largest).map(|(_, v)| sign * v);
    (largest, [0; 3].map(|_| others.next().unwrap_or(0.0)))
}

/// The inverse of [`smallest_three`] for an index below 4; the missing component follows from the unit length.
pub(super) fn from_smallest_three(largest: usize, [a, b, c]: [f32; 3]) -> [f32; 4] {
    let m = (1.0 - (a * a + b * b + c * c)).max(0.0).sqrt();
    match largest {
        0 => [m, a, b, c],
        1 => [a, m, b, c],
        2 => [a, b, m, c],
        _ => [a, b, c, m],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stored_opacity_comes_back_as_itself_and_finite() {
        for level in 0..=255 {
            let logit = logit_from_u8(level);
            assert!(logit.is_finite());
            assert_eq!(opacity_to_u8(logit), level);
        }
        assert_eq!([f32::NEG_INFINITY, f32::INFINITY].map(opacity_to_u8), [0, 255]);
    }

    #[test]
    fn smallest_three_keep_the_rotation() {
        for quat in [[0.5, -0.5, 0.5, -0.5], [0.1, 0.2, -0.9, 0.3], [-1.0, 0.0, 0.0, 0.0], [1e-30, 1e-30, 0.0, 2e-30]] {
            let unit = normalized(quat);
            let (largest, others) = smallest_three(unit);
            let back = from_smallest_three(largest, others);
            let dot: f32 = unit.iter().zip(back).map(|(a, b)| a * b).sum();
            assert!((dot.abs() - 1.0).abs() < 1e-6, "{quat:?}");
        }
        assert_eq!(normalized([0.0; 4]), [1.0, 0.0, 0.0, 0.0]);
        assert_eq!(normalized([f32::NAN, 0.0, 0.0, 0.0]), [1.0, 0.0, 0.0, 0.0]);
    }
}
