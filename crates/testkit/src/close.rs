//! How far two arrays lie apart, and an assertion whose message says so.

/// Distance of an array from the one expected. Non-finite values in either count as infinitely far, unless both are equal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// ‖found − expected‖₂ / ‖expected‖₂; the plain norm ‖found‖₂ where everything expected is zero.
    pub relative_l2: f64,
    /// Largest absolute difference.
    pub max_abs: f64,
    /// Mean absolute difference (0 for empty arrays).
    pub mean_abs: f64,
    /// Position of `max_abs` (0 for empty arrays).
    pub worst: usize,
    /// Value found at `worst`.
    pub found: f64,
    /// Value expected at `worst`.
    pub expected: f64,
    /// Largest absolute value expected.
    pub scale: f64,
    /// Number of values compared.
    pub len: usize,
}

/// Measures how far `found` lies from `expected`.
///
/// # Panics
/// If the lengths differ: that is a mistake of the test.
pub fn difference<A: Copy + Into<f64>, B: Copy + Into<f64>>(found: &[A], expected: &[B]) -> Difference {
    assert_eq!(found.len(), expected.len(), "arrays to compare differ in length (found, expected)");
    let mut d = Difference {
        relative_l2: 0.0,
        max_abs: 0.0,
        mean_abs: 0.0,
        worst: 0,
        found: f64::NAN,
        expected: f64::NAN,
        scale: 0.0,
        len: found.len(),
    };
    let (mut sum, mut sum_squares, mut norm) = (0.0, 0.0, 0.0);
    for (i, (&a, &b)) in found.iter().zip(expected).enumerate() {
        let (a, b): (f64, f64) = (a.into(), b.into());
        let mut e = if a == b { 0.0 } else { (a - b).abs() };
        if e.is_nan() {
            e = f64::INFINITY;
        }
        sum += e;
        sum_squares += e * e;
        norm += b * b;
        d.scale = d.scale.max(b.abs());
        if i == 0 || e > d.max_abs {
            (d.max_abs, d.worst, d.found, d.expected) = (e, i, a, b);
        }
    }
    d.mean_abs = if found.is_empty() { 0.0 } else { sum / found.len() as f64 };
    d.relative_l2 = if norm > 0.0 { (sum_squares / norm).sqrt() } else { sum_squares.sqrt() };
    d
}

/// Largest differences that count as equal; a bound left at infinity is not checked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    /// Bound on [`Difference::relative_l2`].
    pub relative_l2: f64,
    /// Bound on [`Difference::max_abs`].
    pub max_abs: f64,
    /// Bound on [`Difference::mean_abs`].
    pub mean_abs: f64,
}

impl Tolerance {
    /// Bounds nothing.
    pub const NONE: Self = Self { relative_l2: f64::INFINITY, max_abs: f64::INFINITY, mean_abs: f64::INFINITY };

    /// Bounds the relative L2 distance only.
    pub fn relative_l2(bound: f64) -> Self {
        Self { relative_l2: bound, ..Self::NONE }
    }

    /// Bounds the largest absolute difference only.
    pub fn max_abs(bound: f64) -> Self {
        Self { max_abs: bound, ..Self::NONE }
    }

    /// What `d` violates, as text; `None` when it is within all bounds.
    pub fn violation(&self, d: &Difference) -> Option<String> {
        let rows = [
            ("relative L2", d.relative_l2, self.relative_l2),
            ("largest", d.max_abs, self.max_abs),
            ("mean", d.mean_abs, self.mean_abs),
        ];
        let broken: Vec<String> = rows
            .iter()
            .filter(|(_, value, bound)| value.is_nan() || value > bound)
            .map(|(name, value, bound)| format!("{name} difference {value:.3e} is above {bound:.3e}"))
            .collect();
        if broken.is_empty() {
            return None;
        }
        Some(format!(
            "{} ({} values, worst at {}: found {:e}, expected {:e}, largest expected {:.3e})",
            broken.join("; "),
            d.len,
            d.worst,
            d.found,
            d.expected,
            d.scale
        ))
    }
}

/// Asserts that `found` equals `expected` within `tolerance`, and returns the difference.
///
/// # Panics
/// If it does not: `what` opens the message, which names the bound, the worst position and both values there.
#[track_caller]
pub fn assert_close<A: Copy + Into<f64>, B: Copy + Into<f64>>(
    what: &str,
    found: &[A],
    expected: &[B],
    tolerance: Tolerance,
) -> Difference {
    let d = difference(found, expected);
    if let Some(violation) = tolerance.violation(&d) {
        panic!("{what}: {violation}");
    }
    d
}

/// Asserts that every value is finite.
///
/// # Panics
/// If one is not, naming the first position and how many there are.
#[track_caller]
pub fn assert_finite<A: Copy + Into<f64>>(what: &str, values: &[A]) {
    let mut bad = values.iter().enumerate().filter(|(_, v)| !Into::<f64>::into(**v).is_finite());
    if let Some((index, &value)) = bad.next() {
        let value: f64 = value.into();
        panic!("{what}: {value} at {index}, {} non-finite of {} values", 1 + bad.count(), values.len());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_arrays_have_no_difference() {
        let d = assert_close(
            "equal",
            &[1.0f32, -2.0, f32::INFINITY],
            &[1.0f32, -2.0, f32::INFINITY],
            Tolerance::max_abs(0.0),
        );
        assert_eq!((d.max_abs, d.mean_abs), (0.0, 0.0));
    }

    #[test]
    fn difference_of_a_known_pair() {
        let d = difference(&[3.0f64, 4.0, 0.5], &[3.0f64, 4.0, 0.0]);
        assert_eq!((d.relative_l2, d.max_abs, d.worst), (0.1, 0.5, 2));
        assert!((d.mean_abs - 0.5 / 3.0).abs() < 1e-15);
    }

    #[test]
    fn nan_is_far_from_everything() {
        assert_eq!(difference(&[f64::NAN], &[0.0f64]).max_abs, f64::INFINITY);
        assert!(Tolerance::relative_l2(1.0).violation(&difference(&[f64::NAN], &[1.0f64])).is_some());
    }

    #[test]
    #[should_panic(expected = "image: largest difference 1.000e0 is above 5.000e-1")]
    fn message_names_bound_and_place() {
        assert_close("image", &[1.0f32, 2.0], &[1.0f32, 1.0], Tolerance::max_abs(0.5));
    }
}
