//! Where the time of a step goes.

use std::time::Instant;

/// Milliseconds since the last lap and since the start.
pub(super) struct Clock {
    start: Instant,
    last: Instant,
}

impl Clock {
    pub(super) fn start() -> Self {
        let now = Instant::now();
        Self { start: now, last: now }
    }

    pub(super) fn lap(&mut self) -> f32 {
        let now = Instant::now();
        let ms = (now - self.last).as_secs_f32() * 1e3;
        self.last = now;
        ms
    }

    pub(super) fn total(&self) -> f32 {
        self.start.elapsed().as_secs_f32() * 1e3
    }
}
