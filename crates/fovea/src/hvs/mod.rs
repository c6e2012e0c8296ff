//! Models of human vision: features of early vision ([`pyramid`]), the regions over which the eye averages them
//! ([`pooling`]), and how small a difference of colours is seen at all ([`jnd`]).

pub mod jnd;
pub mod pooling;
pub mod pyramid;
