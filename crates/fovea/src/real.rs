//! Floating-point types the slice kernels are written for, and the vector width they are compiled for.
//!
//! The kernels are plain loops over `T: Real`: `f32` in the product, `f64` where a test wants digits that finite
//! differences can see. [`dispatch`] compiles a [`Task`] for every level of [`gazesplat_render::simd`]; the parameter
//! `FMA` says whether a fused multiply-add is one instruction: in baseline code `f32::mul_add` is a library call.

use gazesplat_render::simd::{Kernel, Scalar, Simd};
use std::any::TypeId;
use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub};

/// `f32` or `f64`.
pub trait Real:
    Copy
    + Debug
    + Default
    + PartialOrd
    + Send
    + Sync
    + 'static
    + Add<Output = Self>
    + AddAssign
    + Sub<Output = Self>
    + Mul<Output = Self>
    + MulAssign
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// The nearest value.
    fn of(v: f64) -> Self;
    /// The same value.
    fn to_f64(self) -> f64;
    /// √self.
    fn sqrt(self) -> Self;
    /// |self|.
    fn abs(self) -> Self;
    /// self · b + c, rounded once.
    fn fused(self, b: Self, c: Self) -> Self;
}

macro_rules! real {
    ($t:ty) => {
        impl Real for $t {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            #[inline(always)]
            fn of(v: f64) -> Self {
                v as $t
            }
            #[inline(always)]
            fn to_f64(self) -> f64 {
                f64::from(self)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                <$t>::sqrt(self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                <$t>::abs(self)
            }
            #[inline(always)]
            fn fused(self, b: Self, c: Self) -> Self {
                self.mul_add(b, c)
            }
        }
    };
}
real!(f32);
real!(f64);

/// a · b + c, fused where that is one instruction.
#[inline(always)]
pub(crate) fn fma<T: Real, const FMA: bool>(a: T, b: T, c: T) -> T {
    if FMA { a.fused(b, c) } else { a * b + c }
}

/// out += w · row.
#[inline(always)]
pub(crate) fn add_scaled<T: Real, const FMA: bool>(out: &mut [T], w: T, row: &[T]) {
    for (o, v) in out.iter_mut().zip(row) {
        *o = fma::<T, FMA>(w, *v, *o);
    }
}

/// Sum of `values` in 16 interleaved partial sums, combined in `f64`: the same order at every vector width.
#[inline(always)]
pub(crate) fn sum<T: Real>(values: &[T]) -> f64 {
    let mut lanes = [T::ZERO; 16];
    let mut chunks = values.chunks_exact(16);
    for chunk in &mut chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane += *value;
        }
    }
    let tail: f64 = chunks.remainder().iter().map(|v| v.to_f64()).sum();
    lanes.iter().map(|v| v.to_f64()).sum::<f64>() + tail
}

/// Σ w · v, in the order of [`sum`].
#[inline(always)]
pub(crate) fn dot<T: Real>(weights: &[T], values: &[T]) -> f64 {
    let mut lanes = [T::ZERO; 16];
    let num = values.len() / 16 * 16;
    for (w, v) in weights[..num].chunks_exact(16).zip(values[..num].chunks_exact(16)) {
        for i in 0..16 {
            lanes[i] += w[i] * v[i];
        }
    }
    let tail: f64 = weights[num..].iter().zip(&values[num..]).map(|(w, v)| (*w * *v).to_f64()).sum();
    lanes.iter().map(|v| v.to_f64()).sum::<f64>() + tail
}

/// A computation that is compiled for every vector width. Mark `run` and everything it calls `#[inline(always)]`.
pub(crate) trait Task {
    /// What it returns.
    type Output;
    /// The computation.
    fn run<const FMA: bool>(self) -> Self::Output;
}

/// Runs `task` at the vector width of this machine.
#[inline(always)]
pub(crate) fn dispatch<K: Task>(task: K) -> K::Output {
    struct Plain<K>(K);
    impl<K: Task> Kernel for Plain<K> {
        type Output = K::Output;
        #[inline(always)]
        fn run<S: Simd>(self, _: S) -> K::Output {
            if TypeId::of::<S>() == TypeId::of::<Scalar>() { self.0.run::<false>() } else { self.0.run::<true>() }
        }
    }
    gazesplat_render::simd::dispatch(Plain(task))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_take_every_value() {
        let values: Vec<f32> = (0..37).map(|i| i as f32).collect();
        assert_eq!(sum(&values), 666.0);
        assert_eq!(dot(&values, &values), (0..37).map(|i| f64::from(i * i)).sum::<f64>());
    }
}
