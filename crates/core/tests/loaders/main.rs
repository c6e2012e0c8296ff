//! Scene loading, from files the tests write themselves and from real captures.

#![expect(clippy::unwrap_used, reason = "a helper of a test may panic like the test")]

mod colmap;
mod images;
mod real_scenes;
mod scenes;
mod transforms;
