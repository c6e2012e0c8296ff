//! Sixteen `f32` lanes, one per pixel of a tile row, on whatever the processor offers.
//!
//! A kernel is written once against [`Simd`] and compiled three times: AVX-512 (one register), AVX2 + FMA (two
//! registers) and portable scalar code. [`dispatch`] picks the best level the processor has, at run time. Results of
//! one level are reproducible bit for bit; levels differ by rounding (fused against separate multiply-add).

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod scalar;

#[cfg(target_arch = "x86_64")]
pub use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
pub use avx512::Avx512;
pub use scalar::Scalar;

use std::sync::atomic::{AtomicU8, Ordering};

/// Number of lanes: the pixels of one row of a 16 × 16 tile.
pub const LANES: usize = 16;

/// An instruction set the kernels are compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SimdLevel {
    /// AVX-512 F, BW, DQ and VL.
    Avx512,
    /// AVX2 and FMA.
    Avx2,
    /// No assumption about the processor.
    Scalar,
}

impl SimdLevel {
    /// All levels, best first.
    pub const ALL: [Self; 3] = [Self::Avx512, Self::Avx2, Self::Scalar];

    /// Whether this processor can run the level.
    pub fn is_available(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => Avx512::detect().is_some(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => Avx2::detect().is_some(),
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx512 | Self::Avx2 => false,
            Self::Scalar => true,
        }
    }

    /// The best level of this processor.
    pub fn best() -> Self {
        Self::ALL.into_iter().find(|l| l.is_available()).unwrap_or(Self::Scalar)
    }
}

/// Level forced by [`force_level`]; 0 = none, else 1 + index into [`SimdLevel::ALL`].
static FORCED: AtomicU8 = AtomicU8::new(0);

/// The level kernels run at: the best of the processor, unless [`force_level`] says otherwise.
pub fn level() -> SimdLevel {
    match FORCED.load(Ordering::Relaxed) {
        0 => SimdLevel::best(),
        n => SimdLevel::ALL[usize::from(n) - 1],
    }
}

/// Makes the whole process run at `level` (tests and benches), or at the best one again with `None`.
///
/// # Panics
/// If the processor does not have the level.
pub fn force_level(level: Option<SimdLevel>) {
    if let Some(level) = level {
        assert!(level.is_available(), "this processor cannot run {level:?}");
    }
    let code = level.map_or(0, |l| match l {
        SimdLevel::Avx512 => 1,
        SimdLevel::Avx2 => 2,
        SimdLevel::Scalar => 3,
    });
    FORCED.store(code, Ordering::Relaxed);
}

/// A computation that can run at any level. Mark `run` and everything it calls `#[inline(always)]`: only code inlined
/// into the entry point of a level is compiled for that level.
pub trait Kernel {
    /// What it returns.
    type Output;
    /// The computation.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// Runs `kernel` at [`level`].
pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    match level() {
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => {
            if let Some(simd) = Avx512::detect() {
                return simd.run(kernel);
            }
        }
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => {
            if let Some(simd) = Avx2::detect() {
                return simd.run(kernel);
            }
        }
        _ => {}
    }
    kernel.run(Scalar)
}

/// Compiles the scalar computation `f` for every level and runs it at [`level`]: wider registers, rounding and square
/// roots without library calls. Rust never fuses multiply and add by itself, so the bits are the same at every level.
/// `f` and what it calls must be `#[inline(always)]`.
#[inline(always)]
pub fn vectorize<R>(f: impl FnOnce() -> R) -> R {
    struct Plain<F>(F);
    impl<R, F: FnOnce() -> R> Kernel for Plain<F> {
        type Output = R;
        #[inline(always)]
        fn run<S: Simd>(self, _: S) -> R {
            (self.0)()
        }
    }
    dispatch(Plain(f))
}

/// Asks for the cache line of `value` ahead of its use. Worth a tenth of the forward rasteriser (`benches/passes.rs`).
#[inline(always)]
pub fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: every x86-64 has SSE, and a prefetch never faults or changes anything.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

/// Index of the last entry of a table that is gathered from.
///
/// # Panics
/// If the table is empty, or longer than indices reach.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn last_index(table: &[f32]) -> i32 {
    assert!(!table.is_empty() && i32::try_from(table.len()).is_ok(), "a table holds 1 to 2³¹ − 1 entries");
    table.len() as i32 - 1
}

/// 2ᶠ as a degree-5 polynomial in f ∈ [0, 1): minimax in relative error with the constant term pinned to 1, highest
/// power first. Largest relative error 1.4e-7 in `f32` with fused steps.
pub const EXP2_POLYNOMIAL: [f32; 5] = [1.867_132_4e-3, 9.017_025e-3, 5.579_991_6e-2, 2.401_643_4e-1, 6.931_513e-1];

/// Operations on sixteen lanes. `self` is a token that proves the instruction set is there.
pub trait Simd: Copy + Send + Sync + 'static {
    /// Sixteen `f32`.
    type F: Copy;
    /// Sixteen `i32`.
    type I: Copy;
    /// Sixteen booleans.
    type M: Copy;

    /// The same value in all lanes.
    fn splat(self, v: f32) -> Self::F;
    /// The same integer in all lanes.
    fn splat_i(self, v: i32) -> Self::I;
    /// Reads sixteen lanes.
    fn load(self, src: &[f32; LANES]) -> Self::F;
    /// Writes sixteen lanes.
    fn store(self, v: Self::F, dst: &mut [f32; LANES]);
    /// Reads sixteen integers.
    fn load_i(self, src: &[i32; LANES]) -> Self::I;
    /// Writes sixteen integers.
    fn store_i(self, v: Self::I, dst: &mut [i32; LANES]);
    /// a + b.
    fn add(self, a: Self::F, b: Self::F) -> Self::F;
    /// a − b.
    fn sub(self, a: Self::F, b: Self::F) -> Self::F;
    /// a · b.
    fn mul(self, a: Self::F, b: Self::F) -> Self::F;
    /// a · b + c.
    fn fma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// c − a · b.
    fn fnma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// The smaller of a and b.
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    /// The larger of a and b.
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    /// |a|.
    fn abs(self, a: Self::F) -> Self::F;
    /// a / b, correctly rounded.
    fn div(self, a: Self::F, b: Self::F) -> Self::F;
    /// 1 / a for normal a, relative error below 3e-7.
    fn recip(self, a: Self::F) -> Self::F;
    /// a ≥ b; false for NaN.
    fn ge(self, a: Self::F, b: Self::F) -> Self::M;
    /// a > b; false for NaN.
    fn gt(self, a: Self::F, b: Self::F) -> Self::M;
    /// a > b where `m` is set; false for NaN.
    fn gt_where(self, m: Self::M, a: Self::F, b: Self::F) -> Self::M;
    /// a > b for integers, where `m` is set.
    fn gt_i_where(self, m: Self::M, a: Self::I, b: Self::I) -> Self::M;
    /// a and not b.
    fn and_not(self, a: Self::M, b: Self::M) -> Self::M;
    /// Lane i as bit i.
    fn bits(self, m: Self::M) -> u16;
    /// Mask with lane i = bit i.
    fn mask(self, bits: u16) -> Self::M;
    /// `yes` where the mask is set, else `no`.
    fn select(self, m: Self::M, yes: Self::F, no: Self::F) -> Self::F;
    /// `yes` where the mask is set, else `no`.
    fn select_i(self, m: Self::M, yes: Self::I, no: Self::I) -> Self::I;
    /// `a` where the mask is set, else 0.
    fn keep(self, m: Self::M, a: Self::F) -> Self::F;
    /// −|a|.
    fn neg_abs(self, a: Self::F) -> Self::F;
    /// p − ⌊p⌋, for p ∈ [−126, 1].
    fn fraction(self, p: Self::F) -> Self::F;
    /// y · 2^⌊p⌋ where the mask is set, else 0; p ∈ [−126, 1] where it is set, anything else elsewhere.
    fn scale_by_floor(self, m: Self::M, y: Self::F, p: Self::F) -> Self::F;
    /// a · b where the mask is set, else 0.
    fn mul_where(self, m: Self::M, a: Self::F, b: Self::F) -> Self::F;
    /// a without its fraction, for 0 ≤ a < 2³¹.
    fn truncate(self, a: Self::F) -> Self::F;
    /// The entries of `table` at whole numbers; indices behind its end read its last entry.
    ///
    /// # Panics
    /// If the table is empty.
    fn lookup(self, table: &[f32], index: Self::F) -> Self::F;
    /// The largest lane.
    fn reduce_max(self, a: Self::F) -> f32;
    /// The sums over the lanes of four vectors, in a fixed order.
    fn reduce_sum4(self, a: Self::F, b: Self::F, c: Self::F, d: Self::F) -> [f32; 4];

    /// 2ᵖ where the mask is set, else 0; p ∈ [−126, 1] where it is set. Masked lanes compute nothing: far from a splat
    /// the result would be denormal, and operations on those are a hundred times slower.
    #[inline(always)]
    fn exp2_where(self, m: Self::M, p: Self::F) -> Self::F {
        let f = self.fraction(p);
        let [c5, c4, c3, c2, c1] = EXP2_POLYNOMIAL;
        let y = self.fma(self.splat(c5), f, self.splat(c4));
        let y = self.fma(y, f, self.splat(c3));
        let y = self.fma(y, f, self.splat(c2));
        let y = self.fma(y, f, self.splat(c1));
        let y = self.fma(y, f, self.splat(1.0));
        self.scale_by_floor(m, y, p)
    }
}

#[cfg(test)]
mod tests;
