//! Run-time choice of vector width for this crate's slice kernels.
//!
//! A kernel is one generic `#[inline(always)]` function of plain loops; [`dispatch_simd`] compiles it three times
//! (AVX-512, AVX2 + FMA, baseline) and picks one by [`gazesplat_render::simd::level`]. The const parameter `FMA` says
//! whether a fused multiply-add is one instruction: in baseline code `f32::mul_add` is a library call.

use gazesplat_render::simd::EXP2_POLYNOMIAL;

/// a · b + c, fused where that is one instruction.
#[inline(always)]
pub(crate) fn fma<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// eˣ with a relative error below 4e-6 (1e-7 near 0); 1e-38 below −87, 2.4e38 above 88.
#[inline(always)]
pub(crate) fn exp<const FMA: bool>(x: f32) -> f32 {
    let p = (x * std::f32::consts::LOG2_E).clamp(-126.0, 127.5);
    let floor = p.floor();
    let f = p - floor;
    let mut poly = EXP2_POLYNOMIAL[0];
    for c in &EXP2_POLYNOMIAL[1..] {
        poly = fma::<FMA>(poly, f, *c);
    }
    poly = fma::<FMA>(poly, f, 1.0);
    // The polynomial lies in [1, 2): the integer part goes into its exponent.
    f32::from_bits(poly.to_bits().wrapping_add((floor as i32 as u32) << 23))
}

/// Sum of `values` in 16 interleaved partial sums, combined in `f64`: the same order at every vector width.
#[inline(always)]
pub(crate) fn sum_lanes(values: &[f32]) -> f64 {
    let mut lanes = [0.0f32; 16];
    let mut chunks = values.chunks_exact(16);
    for chunk in &mut chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane += value;
        }
    }
    let tail: f64 = chunks.remainder().iter().map(|&v| f64::from(v)).sum();
    lanes.iter().map(|&v| f64::from(v)).sum::<f64>() + tail
}

/// Defines `fn name(args)` that runs `kernel::<FMA>(args)` at the vector width of this machine.
macro_rules! dispatch_simd {
    ($(#[$meta:meta])* $vis:vis fn $name:ident $(<$($gen:ident : $bound:path),*>)? ($($arg:ident : $ty:ty),* $(,)?) $(-> $ret:ty)? = $kernel:ident;) => {
        $(#[$meta])*
        $vis fn $name $(<$($gen: $bound),*>)? ($($arg: $ty),*) $(-> $ret)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
                fn avx512 $(<$($gen: $bound),*>)? ($($arg: $ty),*) $(-> $ret)? {
                    $kernel::<true $(, $($gen),*)?>($($arg),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2 $(<$($gen: $bound),*>)? ($($arg: $ty),*) $(-> $ret)? {
                    $kernel::<true $(, $($gen),*)?>($($arg),*)
                }
                match gazesplat_render::simd::level() {
                    // SAFETY: `level` reports AVX-512 only after detecting F, VL, BW, DQ, AVX2 and FMA on this CPU.
                    gazesplat_render::simd::SimdLevel::Avx512 => return unsafe { avx512($($arg),*) },
                    // SAFETY: `level` reports AVX2 only after detecting AVX2 and FMA on this CPU.
                    gazesplat_render::simd::SimdLevel::Avx2 => return unsafe { avx2($($arg),*) },
                    gazesplat_render::simd::SimdLevel::Scalar => {}
                }
            }
            $kernel::<false $(, $($gen),*)?>($($arg),*)
        }
    };
}
pub(crate) use dispatch_simd;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_close_over_its_range() {
        for i in -8600..=8700 {
            let x = i as f32 * 0.01;
            let (found, expected) = (f64::from(exp::<false>(x)), f64::from(x).exp());
            assert!((found / expected - 1.0).abs() < 8e-6, "{x}: {found} {expected}");
        }
        assert!(exp::<false>(-200.0) < 1e-37 && exp::<false>(200.0).is_finite());
    }
}
