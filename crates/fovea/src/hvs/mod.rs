//! Models of early vision: features ([`pyramid`]) and the regions over which the eye averages them ([`pooling`]).

pub mod pooling;
pub mod pyramid;
