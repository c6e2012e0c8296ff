//! What Adam would have done to a value in updates that brought it no gradient, in closed form.
//!
//! Without a gradient the moments only decay: after j more updates they are m β1ʲ and v β2ʲ, and update number u = t₀ + j
//! moves the value by −lr · m Aⱼ / (√v Bⱼ + ε), Aⱼ = β1ʲ / (1 − β1ᵘ), Bⱼ = β2^{j/2} / √(1 − β2ᵘ) (Kingma 2015, Algorithm 1).
//! The sum over j = 1..k is lr · m · Σ wⱼ / (√v + ε xⱼ) with wⱼ = Aⱼ / Bⱼ and xⱼ = 1 / Bⱼ: it depends on the value through √v
//! only. Where ε does not matter it is Σ wⱼ / √v. Where it does, the sum is an integral of 1 / (√v + ε x) over a measure with
//! the weights wⱼ, and the Gauss rule with two nodes, which has the measure's first four moments, takes its place. The xⱼ
//! differ little, by β2^{j/2} and what bias correction is left, so that the rule is as good as exact: at any ε / √v its
//! relative error is below 1e-7 from update 512 on, 2⁻²⁴ from 1000 on. Before that every value is updated in every update.

use super::AdamSettings;

/// Updates that a row misses at most: then it is caught up with all others. Every 256 updates one pass over all rows is
/// less than half a per cent of the work, and tables stay small.
pub const MAX_MISSED: u32 = 256;
/// Updates before which no row misses any: the bias correction changes too fast for the closed form.
pub const DENSE_UPDATES: u32 = 512;
/// Bit of a row's word that says: its values are up to date for the update under way, its moments are as the other bits
/// say.
pub const PREPARED: u32 = 1 << 31;

/// A relative spread below this is that of one node, or rounding.
const MIN_VARIANCE: f64 = 1e-12;

/// What k missed updates come to: the value moves by −lr · m · (w₀ / (√v + e₀) + w₁ / (√v + e₁)), the moments decay.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Missed {
    /// w₀ and w₁.
    pub weights: [f32; 2],
    /// e₀ and e₁: ε times a node.
    pub epsilons: [f32; 2],
    /// β1ᵏ.
    pub decay1: f32,
    /// β2ᵏ.
    pub decay2: f32,
}

/// Values of an entry in [`flattened`] tables.
pub const ENTRY: usize = 6;

/// What k = 0, 1, … updates up to number `through` come to that brought no gradient: an entry for each k up to
/// [`MAX_MISSED`] or, before that, `through`.
///
/// One more missed update puts a term before the others: with r = β1 / β2^{(n+1)/2}, the n-th moment of the measure is
/// Mₖ = r (h(u) + Mₖ₋₁), h(u) = (1 − β2ᵘ)^{(n+1)/2} / (1 − β1ᵘ), u = `through` − k + 1.
pub fn missed(settings: &AdamSettings, through: u32) -> Vec<Missed> {
    let &AdamSettings { beta1, beta2, epsilon, .. } = settings;
    let root = beta2.sqrt();
    let ratios = [1, 2, 3, 4].map(|power| beta1 / root.powi(power));
    let mut moments = [0.0f64; 4];
    let (mut decay1, mut decay2) = (1.0f64, 1.0f64);
    let mut entries = vec![Missed { weights: [0.0; 2], epsilons: [epsilon as f32; 2], decay1: 1.0, decay2: 1.0 }];
    for k in 1..=MAX_MISSED.min(through) {
        let u = f64::from(through - k + 1);
        let correction = (1.0 - beta2.powf(u)).sqrt();
        let mut h = 1.0 / (1.0 - beta1.powf(u));
        for (moment, ratio) in moments.iter_mut().zip(ratios) {
            h *= correction;
            *moment = ratio * (h + *moment);
        }
        decay1 *= beta1;
        decay2 *= beta2;
        let (weights, nodes) = gauss_rule(moments);
        entries.push(Missed {
            weights: weights.map(|w| w as f32),
            epsilons: nodes.map(|x| (epsilon * x) as f32),
            decay1: decay1 as f32,
            decay2: decay2 as f32,
        });
    }
    entries
}

/// Weights and nodes of the Gauss rule with two nodes for the measure with the moments 0 to 3.
fn gauss_rule(moments: [f64; 4]) -> ([f64; 2], [f64; 2]) {
    let total = moments[0];
    let [m1, m2, m3] = [1, 2, 3].map(|n: usize| moments[n] / total);
    let variance = m2 - m1 * m1;
    if variance <= MIN_VARIANCE * m1 * m1 {
        return ([total, 0.0], [m1; 2]);
    }
    // Around the mean the nodes are the roots of z² − γ z − σ², γ = third central moment over the variance.
    let third = m3 - 3.0 * m1 * m2 + 2.0 * m1 * m1 * m1;
    let skew = third / variance;
    let width = (skew * skew + 4.0 * variance).sqrt();
    let (low, high) = (0.5 * (skew - width), 0.5 * (skew + width));
    ([total * high / width, total * -low / width], [m1 + low, m1 + high])
}

/// The entries one behind the other, as a device reads them: weights, epsilons, decays.
pub fn flattened(entries: &[Missed]) -> Vec<f32> {
    entries
        .iter()
        .flat_map(|e| [e.weights[0], e.weights[1], e.epsilons[0], e.epsilons[1], e.decay1, e.decay2])
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Σ wⱼ / (√v + ε xⱼ), term by term.
    fn direct(settings: &AdamSettings, through: u32, k: u32, root_v: f64) -> f64 {
        let &AdamSettings { beta1, beta2, epsilon, .. } = settings;
        (1..=k)
            .map(|j| {
                let u = f64::from(through - k + j);
                let a = beta1.powi(j.cast_signed()) / (1.0 - beta1.powf(u));
                let b = beta2.powf(0.5 * f64::from(j)) / (1.0 - beta2.powf(u)).sqrt();
                a / (root_v * b + epsilon)
            })
            .sum()
    }

    fn closed(entry: &Missed, root_v: f64) -> f64 {
        (0..2).map(|i| f64::from(entry.weights[i]) / (root_v + f64::from(entry.epsilons[i]))).sum()
    }

    fn worst(through: u32, num_missed: &[u32]) -> f64 {
        let settings = AdamSettings::default();
        let table = missed(&settings, through);
        let mut worst = 0.0f64;
        for &k in num_missed {
            for decade in -24..=4 {
                let root_v = 10f64.powi(decade);
                let expected = direct(&settings, through, k, root_v);
                worst = worst.max((closed(&table[k as usize], root_v) / expected - 1.0).abs());
            }
        }
        worst
    }

    #[test]
    fn closed_form_equals_the_sum_of_all_terms_at_every_scale_of_the_moments() {
        // The entries are rounded to f32: two roundings of weights and nodes are 1.2e-7; the rule adds 1e-7 at most.
        for through in [DENSE_UPDATES + 1, 700, 1000, 3000, 29_999] {
            let most = (through - DENSE_UPDATES).min(MAX_MISSED);
            let num_missed: Vec<u32> =
                [1, 2, 3, 5, 10, 20, 50, 100, 200, 256].into_iter().filter(|k| *k <= most).collect();
            let error = worst(through, &num_missed);
            println!("{through}: {error:e}");
            assert!(error < 2.2e-7, "{through}: {error:e}");
        }
    }

    #[test]
    fn where_epsilon_does_not_matter_the_form_is_exact_from_the_first_update_on() {
        let settings = AdamSettings::default();
        for through in [1, 2, 10, 100] {
            let table = missed(&settings, through);
            assert_eq!(table.len() as u32, through.min(MAX_MISSED) + 1);
            for k in 1..=through {
                let expected = direct(&settings, through, k, 1.0);
                assert!((closed(&table[k as usize], 1.0) / expected - 1.0).abs() < 1.2e-7, "{through} {k}");
            }
        }
    }

    #[test]
    fn one_missed_update_is_that_update_and_none_is_nothing() {
        let settings = AdamSettings::default();
        let table = missed(&settings, 2000);
        assert_eq!(table[0], Missed { weights: [0.0; 2], epsilons: [1e-15; 2], decay1: 1.0, decay2: 1.0 });
        let rate = 0.9 / (1.0 - 0.9f64.powi(2000)) / (0.999f64.sqrt() / (1.0 - 0.999f64.powi(2000)).sqrt());
        assert!((f64::from(table[1].weights[0]) / rate - 1.0).abs() < 6e-8 && table[1].weights[1] == 0.0);
        assert_eq!((table[1].decay1, table[1].decay2), (0.9, 0.999));
        assert_eq!(flattened(&table).len(), ENTRY * (MAX_MISSED as usize + 1));
    }
}
