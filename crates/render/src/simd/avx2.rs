//! The AVX2 + FMA level: two registers hold a row.

use super::{Kernel, LANES, Simd, last_index};
use std::arch::x86_64::*;

/// Proof that the processor has AVX2 and FMA.
#[derive(Debug, Clone, Copy)]
pub struct Avx2(());

/// Two registers of eight lanes, low lanes first.
#[derive(Debug, Clone, Copy)]
pub struct Pair<T>(T, T);

impl Avx2 {
    /// The token, if the processor has the instructions.
    #[inline]
    pub fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Self(()))
    }

    /// Runs `kernel` compiled for this level.
    #[inline]
    pub fn run<K: Kernel>(self, kernel: K) -> K::Output {
        #[target_feature(enable = "avx2,fma")]
        fn entry<K: Kernel>(kernel: K, simd: Avx2) -> K::Output {
            kernel.run(simd)
        }
        // SAFETY: the token exists only where `detect` found every feature `entry` enables.
        unsafe { entry(kernel, self) }
    }
}

// Every intrinsic below needs only the features that the token proves; measured against the scalar level by
// `benches/passes.rs`. Masks are full-width: all bits of a lane set or clear.
impl Simd for Avx2 {
    type F = Pair<__m256>;
    type I = Pair<__m256i>;
    type M = Pair<__m256>;

    #[inline(always)]
    fn splat(self, v: f32) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_set1_ps(v), _mm256_set1_ps(v)) }
    }
    #[inline(always)]
    fn splat_i(self, v: i32) -> Self::I {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_set1_epi32(v), _mm256_set1_epi32(v)) }
    }
    #[inline(always)]
    fn load(self, src: &[f32; LANES]) -> Self::F {
        // SAFETY: the token proves AVX2; the reference spans sixteen readable lanes.
        unsafe { Pair(_mm256_loadu_ps(src.as_ptr()), _mm256_loadu_ps(src.as_ptr().add(8))) }
    }
    #[inline(always)]
    fn store(self, v: Self::F, dst: &mut [f32; LANES]) {
        // SAFETY: the token proves AVX2; the reference spans sixteen writable lanes.
        unsafe {
            _mm256_storeu_ps(dst.as_mut_ptr(), v.0);
            _mm256_storeu_ps(dst.as_mut_ptr().add(8), v.1);
        }
    }
    #[inline(always)]
    fn load_i(self, src: &[i32; LANES]) -> Self::I {
        // SAFETY: the token proves AVX2; the reference spans sixteen readable lanes.
        unsafe { Pair(_mm256_loadu_si256(src.as_ptr().cast()), _mm256_loadu_si256(src.as_ptr().add(8).cast())) }
    }
    #[inline(always)]
    fn store_i(self, v: Self::I, dst: &mut [i32; LANES]) {
        // SAFETY: the token proves AVX2; the reference spans sixteen writable lanes.
        unsafe {
            _mm256_storeu_si256(dst.as_mut_ptr().cast(), v.0);
            _mm256_storeu_si256(dst.as_mut_ptr().add(8).cast(), v.1);
        }
    }
    #[inline(always)]
    fn add(self, a: Self::F, b: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_add_ps(a.0, b.0), _mm256_add_ps(a.1, b.1)) }
    }
    #[inline(always)]
    fn sub(self, a: Self::F, b: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_sub_ps(a.0, b.0), _mm256_sub_ps(a.1, b.1)) }
    }
    #[inline(always)]
    fn mul(self, a: Self::F, b: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_mul_ps(a.0, b.0), _mm256_mul_ps(a.1, b.1)) }
    }
    #[inline(always)]
    fn min(self, a: Self::F, b: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_min_ps(a.0, b.0), _mm256_min_ps(a.1, b.1)) }
    }
    #[inline(always)]
    fn max(self, a: Self::F, b: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_max_ps(a.0, b.0), _mm256_max_ps(a.1, b.1)) }
    }
    #[inline(always)]
    fn fma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_fmadd_ps(a.0, b.0, c.0), _mm256_fmadd_ps(a.1, b.1, c.1)) }
    }
    #[inline(always)]
    fn fnma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_fnmadd_ps(a.0, b.0, c.0), _mm256_fnmadd_ps(a.1, b.1, c.1)) }
    }
    #[inline(always)]
    fn abs(self, a: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            Pair(_mm256_andnot_ps(sign, a.0), _mm256_andnot_ps(sign, a.1))
        }
    }
    #[inline(always)]
    fn div(self, a: Self::F, b: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_div_ps(a.0, b.0), _mm256_div_ps(a.1, b.1)) }
    }
    #[inline(always)]
    fn recip(self, a: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA. Each Newton step squares the 2⁻¹² error of the estimate.
        unsafe {
            let two = _mm256_set1_ps(2.0);
            let newton = |r: __m256, a: __m256| _mm256_mul_ps(r, _mm256_fnmadd_ps(r, a, two));
            Pair(newton(newton(_mm256_rcp_ps(a.0), a.0), a.0), newton(newton(_mm256_rcp_ps(a.1), a.1), a.1))
        }
    }
    #[inline(always)]
    fn ge(self, a: Self::F, b: Self::F) -> Self::M {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_cmp_ps::<_CMP_GE_OQ>(a.0, b.0), _mm256_cmp_ps::<_CMP_GE_OQ>(a.1, b.1)) }
    }
    #[inline(always)]
    fn gt(self, a: Self::F, b: Self::F) -> Self::M {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_cmp_ps::<_CMP_GT_OQ>(a.0, b.0), _mm256_cmp_ps::<_CMP_GT_OQ>(a.1, b.1)) }
    }
    #[inline(always)]
    fn gt_where(self, m: Self::M, a: Self::F, b: Self::F) -> Self::M {
        let gt = self.gt(a, b);
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_and_ps(m.0, gt.0), _mm256_and_ps(m.1, gt.1)) }
    }
    #[inline(always)]
    fn gt_i_where(self, m: Self::M, a: Self::I, b: Self::I) -> Self::M {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe {
            let (g0, g1) = (_mm256_cmpgt_epi32(a.0, b.0), _mm256_cmpgt_epi32(a.1, b.1));
            Pair(_mm256_and_ps(m.0, _mm256_castsi256_ps(g0)), _mm256_and_ps(m.1, _mm256_castsi256_ps(g1)))
        }
    }
    #[inline(always)]
    fn and_not(self, a: Self::M, b: Self::M) -> Self::M {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_andnot_ps(b.0, a.0), _mm256_andnot_ps(b.1, a.1)) }
    }
    #[inline(always)]
    fn bits(self, m: Self::M) -> u16 {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { (_mm256_movemask_ps(m.0) | (_mm256_movemask_ps(m.1) << 8)) as u16 }
    }
    #[inline(always)]
    fn mask(self, bits: u16) -> Self::M {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe {
            let lane = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            let half = |b: u16| {
                let set = _mm256_and_si256(_mm256_set1_epi32(i32::from(b)), lane);
                _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, lane))
            };
            Pair(half(bits & 0xff), half(bits >> 8))
        }
    }
    #[inline(always)]
    fn select(self, m: Self::M, yes: Self::F, no: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_blendv_ps(no.0, yes.0, m.0), _mm256_blendv_ps(no.1, yes.1, m.1)) }
    }
    #[inline(always)]
    fn select_i(self, m: Self::M, yes: Self::I, no: Self::I) -> Self::I {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe {
            let (m0, m1) = (_mm256_castps_si256(m.0), _mm256_castps_si256(m.1));
            Pair(_mm256_blendv_epi8(no.0, yes.0, m0), _mm256_blendv_epi8(no.1, yes.1, m1))
        }
    }
    #[inline(always)]
    fn keep(self, m: Self::M, a: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_and_ps(m.0, a.0), _mm256_and_ps(m.1, a.1)) }
    }
    #[inline(always)]
    fn neg_abs(self, a: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            Pair(_mm256_or_ps(sign, a.0), _mm256_or_ps(sign, a.1))
        }
    }
    #[inline(always)]
    fn fraction(self, p: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe { Pair(_mm256_sub_ps(p.0, _mm256_floor_ps(p.0)), _mm256_sub_ps(p.1, _mm256_floor_ps(p.1))) }
    }
    #[inline(always)]
    fn scale_by_floor(self, m: Self::M, y: Self::F, p: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA. The floor is added to the exponent bits of y ∈ [1, 2].
        unsafe {
            let scale = |y: __m256, p: __m256| {
                let exponent = _mm256_slli_epi32::<23>(_mm256_cvtps_epi32(_mm256_floor_ps(p)));
                _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(y), exponent))
            };
            Pair(_mm256_and_ps(m.0, scale(y.0, p.0)), _mm256_and_ps(m.1, scale(y.1, p.1)))
        }
    }
    #[inline(always)]
    fn mul_where(self, m: Self::M, a: Self::F, b: Self::F) -> Self::F {
        self.keep(m, self.mul(a, b))
    }
    #[inline(always)]
    fn truncate(self, a: Self::F) -> Self::F {
        // SAFETY: the token proves AVX2 and FMA. Immediate 3: towards zero.
        unsafe { Pair(_mm256_round_ps::<3>(a.0), _mm256_round_ps::<3>(a.1)) }
    }
    #[inline(always)]
    fn lookup(self, table: &[f32], index: Self::F) -> Self::F {
        let last = last_index(table);
        // SAFETY: the token proves AVX2 and FMA; as an unsigned number no index is behind the last entry.
        unsafe {
            let last = _mm256_set1_epi32(last);
            let read =
                |i: __m256| _mm256_i32gather_ps::<4>(table.as_ptr(), _mm256_min_epu32(_mm256_cvttps_epi32(i), last));
            Pair(read(index.0), read(index.1))
        }
    }
    #[inline(always)]
    fn reduce_max(self, a: Self::F) -> f32 {
        // SAFETY: the token proves AVX2 and FMA.
        unsafe {
            let m = _mm256_max_ps(a.0, a.1);
            let m = _mm_max_ps(_mm256_castps256_ps128(m), _mm256_extractf128_ps::<1>(m));
            let m = _mm_max_ps(m, _mm_movehl_ps(m, m));
            _mm_cvtss_f32(_mm_max_ss(m, _mm_shuffle_ps::<1>(m, m)))
        }
    }
    #[inline(always)]
    fn reduce_sum4(self, a: Self::F, b: Self::F, c: Self::F, d: Self::F) -> [f32; 4] {
        // SAFETY: the token proves AVX2 and FMA; `out` spans the four floats stored.
        unsafe {
            let half = |v: Pair<__m256>| _mm256_add_ps(v.0, v.1);
            let ab = _mm256_hadd_ps(half(a), half(b));
            let cd = _mm256_hadd_ps(half(c), half(d));
            let abcd = _mm256_hadd_ps(ab, cd);
            let sum = _mm_add_ps(_mm256_castps256_ps128(abcd), _mm256_extractf128_ps::<1>(abcd));
            let mut out = [0.0; 4];
            _mm_storeu_ps(out.as_mut_ptr(), sum);
            out
        }
    }
}
