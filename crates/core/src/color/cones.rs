//! Cone responses and opponent axes.
//!
//! Cones are those of Hunt, Pointer and Estevez as in CIECAM02 (CIE 159:2004); opponent axes those of Derrington,
//! Krauskopf and Lennie, *Chromatic mechanisms in lateral geniculate nucleus of macaque*, 1984: luminance L + M,
//! red–green L − M, blue–yellow S − (L + M). The axes carry no units of their own: whoever takes lengths along them
//! depends on the scaling of the cones (JND Sec. 3.3 does).

use super::xyz::{XYZ_FROM_LINEAR, from_rows};
use glam::{DMat3, DVec3};

/// XYZ to long, middle and short cone responses (CIE 159:2004, Hunt-Pointer-Estevez).
pub const LMS_FROM_XYZ: DMat3 =
    from_rows([[0.389_71, 0.688_98, -0.078_68], [-0.229_81, 1.183_40, 0.046_41], [0.0, 0.0, 1.0]]);

/// Cone responses to luminance, red–green and blue–yellow (Derrington 1984).
pub const DKL_FROM_LMS: DMat3 = from_rows([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 1.0]]);

/// Linear sRGB to opponent axes.
pub fn dkl_from_linear() -> DMat3 {
    DKL_FROM_LMS * LMS_FROM_XYZ * XYZ_FROM_LINEAR
}

/// Cone responses of a linear sRGB colour.
pub fn lms_from_linear(rgb: DVec3) -> DVec3 {
    LMS_FROM_XYZ * (XYZ_FROM_LINEAR * rgb)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_sums_and_differences_of_cones() {
        let rgb = DVec3::new(0.3, 0.6, 0.1);
        let (lms, dkl) = (lms_from_linear(rgb), dkl_from_linear() * rgb);
        assert!((dkl - DVec3::new(lms.x + lms.y, lms.x - lms.y, lms.z - lms.x - lms.y)).length() < 1e-15);
    }
}
