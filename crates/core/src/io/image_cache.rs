//! Decoded photographs within a budget of bytes, so that captures larger than memory train.

use super::images::{TrainingImage, load_view_image};
use crate::error::{Error, Result};
use crate::view::View;
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Photographs of a list of views, decoded on first use and kept until the budget needs their place: the least recently
/// used goes first. All methods may be called from many threads.
///
/// Two threads that ask for the same missing image both decode it and one result is kept. Nobody waits for another
/// thread's decoding: it runs on the thread pool, where a waiting thread could be holding the very job it waits for.
#[derive(Debug)]
pub struct ImageCache {
    views: Vec<View>,
    byte_budget: usize,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    slots: Vec<Option<Slot>>,
    /// Bytes of pixels held here.
    num_bytes: usize,
    /// Bytes of the budget that others use.
    num_reserved: usize,
    clock: u64,
}

#[derive(Debug)]
struct Slot {
    image: Arc<TrainingImage>,
    last_use: u64,
}

impl ImageCache {
    /// An empty cache over `views` that keeps at most `byte_budget` bytes of pixels. Images in use by callers do not count;
    /// with a budget of 0 every access decodes.
    pub fn new(views: Vec<View>, byte_budget: usize) -> Self {
        let slots = views.iter().map(|_| None).collect();
        Self { views, byte_budget, state: Mutex::new(State { slots, num_bytes: 0, num_reserved: 0, clock: 0 }) }
    }

    /// The views, in the order of their indices.
    pub fn views(&self) -> &[View] {
        &self.views
    }

    /// Number of views.
    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// True when there is no view.
    pub fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// Bytes of pixels held now, with those reserved for reduced photographs.
    pub fn num_bytes(&self) -> usize {
        let state = self.lock();
        state.num_bytes + state.num_reserved
    }

    /// The image of view `index`, decoded now if it is not held.
    ///
    /// # Errors
    /// [`Error::Parameter`] when there is no such view; else as [`load_view_image`]. Errors are not remembered.
    pub fn get(&self, index: usize) -> Result<Arc<TrainingImage>> {
        let Some(view) = self.views.get(index) else {
            return Err(Error::parameter("view index", format!("{index}, expected less than {}", self.views.len())));
        };
        if let Some(image) = self.lock().touch(index) {
            return Ok(image);
        }
        let image = Arc::new(load_view_image(view)?);
        Ok(self.lock().insert(index, image, self.byte_budget))
    }

    /// The image of view `index`, not kept if it is not held.
    ///
    /// # Errors
    /// As [`ImageCache::get`].
    pub(super) fn get_unkept(&self, index: usize) -> Result<Arc<TrainingImage>> {
        let held = self.views.get(index).and_then(|_| self.lock().touch(index));
        match (held, self.views.get(index)) {
            (Some(image), _) => Ok(image),
            (None, Some(view)) => load_view_image(view).map(Arc::new),
            (None, None) => self.get(index),
        }
    }

    /// Makes room for `num_bytes` that are held elsewhere, and says whether the budget has as many.
    pub(super) fn reserve(&self, num_bytes: usize) -> bool {
        let mut state = self.lock();
        let fits = state.num_reserved + num_bytes <= self.byte_budget;
        if fits {
            state.num_reserved += num_bytes;
            state.shrink(self.byte_budget);
        }
        fits
    }

    /// Gives back what was reserved.
    pub(super) fn release(&self, num_bytes: usize) {
        self.lock().num_reserved -= num_bytes;
    }

    /// Decodes images in parallel, in the order of the views, until all are held or the budget is full; returns how many
    /// views are held. `progress(done, planned)` is called from many threads after each image.
    ///
    /// # Errors
    /// Of the first view, in order, whose image does not load; as [`load_view_image`].
    pub fn preload(&self, progress: impl Fn(usize, usize) + Sync) -> Result<usize> {
        let planned = self.planned();
        let done = AtomicUsize::new(0);
        let results: Vec<Result<()>> = planned
            .par_iter()
            .map(|&index| {
                if self.lock().slots[index].is_none() {
                    let image = Arc::new(load_view_image(&self.views[index])?);
                    self.lock().insert_if_room(index, image, self.byte_budget);
                }
                progress(done.fetch_add(1, Ordering::Relaxed) + 1, planned.len());
                Ok(())
            })
            .collect();
        results.into_iter().collect::<Result<()>>()?;
        Ok(self.lock().slots.iter().flatten().count())
    }

    /// Decodes view `index` in the background, on the thread pool of the caller, if it is not held. An error shows when the
    /// image is asked for with [`get`](Self::get).
    pub fn prefetch(self: &Arc<Self>, index: usize) {
        if self.lock().slots.get(index).is_some_and(Option::is_none) {
            let cache = Arc::clone(self);
            rayon::spawn(move || drop(cache.get(index)));
        }
    }

    /// The first views whose pixels, without alpha and masks, fit the budget together.
    fn planned(&self) -> Vec<usize> {
        let mut num_bytes = 0;
        (0..self.views.len())
            .take_while(|&index| {
                let intrinsics = &self.views[index].camera.intrinsics;
                num_bytes += 3 * intrinsics.width as usize * intrinsics.height as usize;
                num_bytes <= self.byte_budget
            })
            .collect()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing that can panic runs under the lock, so that a poisoned state is still consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn touch(&mut self, index: usize) -> Option<Arc<TrainingImage>> {
        self.clock += 1;
        let slot = self.slots[index].as_mut()?;
        slot.last_use = self.clock;
        Some(Arc::clone(&slot.image))
    }

    /// Keeps `image`, dropping the least recently used until it fits, and returns the one that is kept.
    fn insert(&mut self, index: usize, image: Arc<TrainingImage>, budget: usize) -> Arc<TrainingImage> {
        if let Some(held) = self.touch(index) {
            return held;
        }
        let needed = image.num_bytes();
        if needed + self.num_reserved <= budget {
            self.shrink(budget - needed);
            self.insert_if_room(index, Arc::clone(&image), budget);
        }
        image
    }

    /// Drops the least recently used until what is held and reserved fits `budget`.
    fn shrink(&mut self, budget: usize) {
        while self.num_bytes > 0 && self.num_bytes + self.num_reserved > budget {
            let oldest = (0..self.slots.len())
                .filter_map(|i| self.slots[i].as_ref().map(|slot| (slot.last_use, i)))
                .min()
                .expect("bytes are held, so that a slot is filled");
            self.evict(oldest.1);
        }
    }

    fn insert_if_room(&mut self, index: usize, image: Arc<TrainingImage>, budget: usize) {
        let needed = image.num_bytes();
        if self.slots[index].is_none() && self.num_bytes + self.num_reserved + needed <= budget {
            self.clock += 1;
            self.num_bytes += needed;
            self.slots[index] = Some(Slot { image, last_use: self.clock });
        }
    }

    fn evict(&mut self, index: usize) {
        if let Some(slot) = self.slots[index].take() {
            self.num_bytes -= slot.image.num_bytes();
        }
    }
}
