//! The portable level: plain loops over sixteen lanes, separate multiply and add.
//!
//! `f32::mul_add` is never used here: without FMA hardware it is a library call per lane, a hundred times slower.

use super::{LANES, Simd};

/// Token of the portable level; always available.
#[derive(Debug, Clone, Copy)]
pub struct Scalar;

#[inline(always)]
fn map2<A: Copy, B: Copy, C: Copy + Default>(a: [A; LANES], b: [B; LANES], f: impl Fn(A, B) -> C) -> [C; LANES] {
    std::array::from_fn(|i| f(a[i], b[i]))
}

/// ⌊p⌋ for |p| < 2³¹ without the library call that `f32::floor` is on a baseline processor.
#[inline(always)]
fn floor(p: f32) -> f32 {
    let truncated = p as i32 as f32;
    if truncated > p { truncated - 1.0 } else { truncated }
}

impl Simd for Scalar {
    type F = [f32; LANES];
    type I = [i32; LANES];
    type M = [bool; LANES];

    #[inline(always)]
    fn splat(self, v: f32) -> Self::F {
        [v; LANES]
    }
    #[inline(always)]
    fn splat_i(self, v: i32) -> Self::I {
        [v; LANES]
    }
    #[inline(always)]
    fn load(self, src: &[f32; LANES]) -> Self::F {
        *src
    }
    #[inline(always)]
    fn store(self, v: Self::F, dst: &mut [f32; LANES]) {
        *dst = v;
    }
    #[inline(always)]
    fn load_i(self, src: &[i32; LANES]) -> Self::I {
        *src
    }
    #[inline(always)]
    fn store_i(self, v: Self::I, dst: &mut [i32; LANES]) {
        *dst = v;
    }
    #[inline(always)]
    fn add(self, a: Self::F, b: Self::F) -> Self::F {
        map2(a, b, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, a: Self::F, b: Self::F) -> Self::F {
        map2(a, b, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, a: Self::F, b: Self::F) -> Self::F {
        map2(a, b, |a, b| a * b)
    }
    #[inline(always)]
    fn fma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    fn fnma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        std::array::from_fn(|i| c[i] - a[i] * b[i])
    }
    #[inline(always)]
    fn min(self, a: Self::F, b: Self::F) -> Self::F {
        map2(a, b, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn max(self, a: Self::F, b: Self::F) -> Self::F {
        map2(a, b, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn abs(self, a: Self::F) -> Self::F {
        a.map(f32::abs)
    }
    #[inline(always)]
    fn div(self, a: Self::F, b: Self::F) -> Self::F {
        map2(a, b, |a, b| a / b)
    }
    #[inline(always)]
    fn recip(self, a: Self::F) -> Self::F {
        a.map(|a| 1.0 / a)
    }
    #[inline(always)]
    fn ge(self, a: Self::F, b: Self::F) -> Self::M {
        map2(a, b, |a, b| a >= b)
    }
    #[inline(always)]
    fn gt(self, a: Self::F, b: Self::F) -> Self::M {
        map2(a, b, |a, b| a > b)
    }
    #[inline(always)]
    fn gt_where(self, m: Self::M, a: Self::F, b: Self::F) -> Self::M {
        std::array::from_fn(|i| m[i] & (a[i] > b[i]))
    }
    #[inline(always)]
    fn gt_i_where(self, m: Self::M, a: Self::I, b: Self::I) -> Self::M {
        std::array::from_fn(|i| m[i] & (a[i] > b[i]))
    }
    #[inline(always)]
    fn and_not(self, a: Self::M, b: Self::M) -> Self::M {
        map2(a, b, |a, b| a & !b)
    }
    #[inline(always)]
    fn bits(self, m: Self::M) -> u16 {
        m.iter().enumerate().fold(0, |bits, (i, &b)| bits | (u16::from(b) << i))
    }
    #[inline(always)]
    fn mask(self, bits: u16) -> Self::M {
        std::array::from_fn(|i| bits >> i & 1 == 1)
    }
    #[inline(always)]
    fn select(self, m: Self::M, yes: Self::F, no: Self::F) -> Self::F {
        std::array::from_fn(|i| if m[i] { yes[i] } else { no[i] })
    }
    #[inline(always)]
    fn select_i(self, m: Self::M, yes: Self::I, no: Self::I) -> Self::I {
        std::array::from_fn(|i| if m[i] { yes[i] } else { no[i] })
    }
    #[inline(always)]
    fn keep(self, m: Self::M, a: Self::F) -> Self::F {
        map2(m, a, |m, a| if m { a } else { 0.0 })
    }
    #[inline(always)]
    fn neg_abs(self, a: Self::F) -> Self::F {
        a.map(|a| -a.abs())
    }
    #[inline(always)]
    fn fraction(self, p: Self::F) -> Self::F {
        p.map(|p| p - floor(p))
    }
    #[inline(always)]
    fn scale_by_floor(self, m: Self::M, y: Self::F, p: Self::F) -> Self::F {
        // The floor is added to the exponent bits of y ∈ [1, 2].
        std::array::from_fn(|i| {
            let exponent = (floor(p[i]) as i32 as u32) << 23;
            if m[i] { f32::from_bits(y[i].to_bits().wrapping_add(exponent)) } else { 0.0 }
        })
    }
    #[inline(always)]
    fn mul_where(self, m: Self::M, a: Self::F, b: Self::F) -> Self::F {
        std::array::from_fn(|i| if m[i] { a[i] * b[i] } else { 0.0 })
    }
    #[inline(always)]
    fn truncate(self, a: Self::F) -> Self::F {
        a.map(|a| a as i32 as f32)
    }
    #[inline(always)]
    fn lookup(self, table: &[f32], index: Self::F) -> Self::F {
        index.map(|i| table[(i as usize).min(table.len() - 1)])
    }
    #[inline(always)]
    fn reduce_max(self, a: Self::F) -> f32 {
        a.into_iter().fold(f32::NEG_INFINITY, f32::max)
    }
    #[inline(always)]
    fn reduce_sum4(self, a: Self::F, b: Self::F, c: Self::F, d: Self::F) -> [f32; 4] {
        [a, b, c, d].map(|v| {
            let quarters: [f32; 4] = std::array::from_fn(|i| (v[i] + v[i + 4]) + (v[i + 8] + v[i + 12]));
            (quarters[0] + quarters[1]) + (quarters[2] + quarters[3])
        })
    }
}
