//! The three levels compute the same things.

use super::{Kernel, LANES, Simd, SimdLevel, dispatch, force_level};
use std::sync::Mutex;

/// The forced level is process-wide; tests that change it take turns.
static TURN: Mutex<()> = Mutex::new(());

struct Exp2(Vec<f32>);
impl Kernel for Exp2 {
    type Output = Vec<f32>;
    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Vec<f32> {
        let mut out = vec![0.0; self.0.len()];
        for (src, dst) in self.0.as_chunks::<LANES>().0.iter().zip(out.as_chunks_mut::<LANES>().0) {
            s.store(s.exp2_where(s.mask(u16::MAX), s.load(src)), dst);
        }
        out
    }
}

struct Reductions([[f32; LANES]; 4]);
impl Kernel for Reductions {
    type Output = ([f32; 4], f32, u16, [f32; LANES], [f32; LANES]);
    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Self::Output {
        let [a, b, c, d] = self.0.map(|v| s.load(&v));
        let m = s.and_not(s.gt_where(s.ge(b, d), a, b), s.ge(c, d));
        let (mut kept, mut inverse) = ([0.0; LANES], [0.0; LANES]);
        s.store(s.select(s.mask(s.bits(m)), s.keep(m, s.neg_abs(a)), s.abs(b)), &mut kept);
        s.store(s.recip(s.add(s.abs(a), s.splat(1e-3))), &mut inverse);
        (s.reduce_sum4(a, b, c, d), s.reduce_max(a), s.bits(m), kept, inverse)
    }
}

struct Lookup(Vec<f32>, [f32; LANES]);
impl Kernel for Lookup {
    type Output = [f32; LANES];
    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Self::Output {
        let mut out = [0.0; LANES];
        s.store(s.lookup(&self.0, s.truncate(s.load(&self.1))), &mut out);
        out
    }
}

#[test]
fn tables_are_read_inside_their_bounds_on_all_levels() {
    let indices = [0.0, 0.99, 1.0, 1.5, 2.0, 3.0, 4.9, 5.0, 6.0, 7.0, 1e9, 100.0, 4.0, 4.5, 0.1, 2.999_999];
    let expected = [0, 0, 1, 1, 2, 3, 4, 5, 6, 6, 6, 6, 4, 4, 0, 2].map(|i| 10.0 + i as f32);
    each_level(|level| {
        let table = (0..7).map(|i| 10.0 + i as f32).collect();
        assert_eq!(dispatch(Lookup(table, indices)), expected, "{level:?}");
    });
}

fn each_level(mut f: impl FnMut(SimdLevel)) {
    let _turn = TURN.lock().expect("no test panics while it holds the turn");
    for level in SimdLevel::ALL {
        if level.is_available() {
            force_level(Some(level));
            f(level);
        } else {
            println!("SKIPPED: this processor has no {level:?}");
        }
    }
    force_level(None);
}

#[test]
fn exp2_is_accurate_to_three_ulp_on_the_range_of_alpha() {
    let p: Vec<f32> = (0..16_000).map(|i| -20.0 + 20.5 * i as f32 / 16_000.0).collect();
    each_level(|level| {
        for (p, y) in p.iter().zip(dispatch(Exp2(p.clone()))) {
            let exact = f64::from(*p).exp2();
            let error = (f64::from(y) / exact - 1.0).abs();
            assert!(error < 3.6e-7, "{level:?}: 2^{p} = {y}, relative error {error:e}");
        }
    });
}

#[test]
fn lane_operations_agree_on_all_levels() {
    let rows: [[f32; LANES]; 4] =
        std::array::from_fn(|r| std::array::from_fn(|i| ((i * 37 + r * 101) % 64) as f32 / 7.0 - 4.0));
    let mut first = None;
    each_level(|level| {
        let out = dispatch(Reductions(rows));
        let reference = first.get_or_insert(out);
        for (a, b) in out.0.iter().zip(reference.0) {
            assert!((a - b).abs() < 1e-5, "{level:?}: sum {a} against {b}");
        }
        assert_eq!((out.1, out.2, out.3), (reference.1, reference.2, reference.3), "{level:?}");
        for (a, b) in out.4.iter().zip(reference.4) {
            assert!((a / b - 1.0).abs() < 3e-7, "{level:?}: reciprocal {a} against {b}");
        }
    });
}
