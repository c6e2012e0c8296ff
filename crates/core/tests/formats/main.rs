//! Compact model formats: round trips within the bounds their tables state, files made by hand from the descriptions of
//! the formats, damaged files.

#![expect(clippy::unwrap_used, reason = "a helper of a test may panic like the test")]

mod by_hand;
mod damaged;
mod round_trip;
mod support;
