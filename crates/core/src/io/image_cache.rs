//! Decoded photographs within a budget of bytes, so that captures larger than memory train.

use super::images::{TrainingImage, load_view_image};
use crate::error::{Error, Result};
use crate::view::View;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Photographs of a list of views, decoded on first use and kept until the budget needs their place: the least recently
/// used goes first. All methods may be called from many threads.
///
/// Several caches may share one budget ([`ImageCache::beside`]). What counts is every byte of decoded pixels, alpha and
/// masks that a cache holds, and the pixels of images that are being decoded: their place is made before decoding begins.
/// What does not count is an image a caller still uses after it was dropped here, and what a decoder needs on the way:
/// the bytes of the file, and the photograph at its full size where that is larger than its view.
///
/// Two threads that ask for the same missing image both decode it and one result is kept. Nobody waits for another
/// thread's decoding: it runs on the thread pool, where a waiting thread could be holding the very job it waits for.
#[derive(Debug)]
pub struct ImageCache {
    views: Vec<View>,
    /// Where the slots of these views begin in the pool.
    first: usize,
    pool: Arc<Pool>,
}

/// What images take and how often they were found; of all caches that share one budget.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CacheStats {
    /// Bytes of pixels that may be held.
    pub byte_budget: usize,
    /// Bytes of pixels held now.
    pub num_bytes: usize,
    /// The most that were held and being decoded at any time, bytes; above the budget only where single images are.
    pub peak_bytes: usize,
    /// Requests that were answered from memory.
    pub num_hits: u64,
    /// Images that were decoded, on request or ahead of it.
    pub num_misses: u64,
}

#[derive(Debug)]
struct Pool {
    byte_budget: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    slots: Vec<Option<Slot>>,
    /// Bytes of pixels held here.
    num_bytes: usize,
    /// Bytes of the images that are being decoded, and of reduced ones that are held elsewhere.
    num_reserved: usize,
    peak_bytes: usize,
    num_hits: u64,
    num_misses: u64,
    clock: u64,
}

#[derive(Debug)]
struct Slot {
    image: Arc<TrainingImage>,
    last_use: u64,
}

impl ImageCache {
    /// An empty cache over `views` that keeps at most `byte_budget` bytes of pixels; with a budget of 0 every access decodes.
    pub fn new(views: Vec<View>, byte_budget: usize) -> Self {
        Self::within(Arc::new(Pool { byte_budget, state: Mutex::default() }), views)
    }

    /// An empty cache over other `views` that shares the budget of this one: an image of either may push out one of the
    /// other.
    pub fn beside(&self, views: Vec<View>) -> Self {
        Self::within(Arc::clone(&self.pool), views)
    }

    fn within(pool: Arc<Pool>, views: Vec<View>) -> Self {
        let mut state = pool.lock();
        let first = state.slots.len();
        state.slots.resize_with(first + views.len(), || None);
        drop(state);
        Self { views, first, pool }
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

    /// Bytes of pixels of these views that are held now.
    pub fn num_bytes(&self) -> usize {
        self.pool.lock().slots[self.slots()].iter().flatten().map(|slot| slot.image.num_bytes()).sum()
    }

    /// Memory and use of the whole budget, whoever shares it.
    pub fn stats(&self) -> CacheStats {
        let state = self.pool.lock();
        CacheStats {
            byte_budget: self.pool.byte_budget,
            num_bytes: state.num_bytes,
            peak_bytes: state.peak_bytes,
            num_hits: state.num_hits,
            num_misses: state.num_misses,
        }
    }

    /// The image of view `index`, decoded now if it is not held.
    ///
    /// # Errors
    /// [`Error::Parameter`] when there is no such view; else as [`load_view_image`]. Errors are not remembered.
    pub fn get(&self, index: usize) -> Result<Arc<TrainingImage>> {
        self.fetch(index, true)
    }

    /// The image of view `index`, not kept if it is not held.
    ///
    /// # Errors
    /// As [`ImageCache::get`].
    pub(super) fn get_unkept(&self, index: usize) -> Result<Arc<TrainingImage>> {
        self.fetch(index, false)
    }

    fn fetch(&self, index: usize, keep: bool) -> Result<Arc<TrainingImage>> {
        let Some(view) = self.views.get(index) else {
            return Err(Error::parameter("view index", format!("{index}, expected less than {}", self.views.len())));
        };
        if let Some(image) = self.pool.lock().hit(self.first + index) {
            return Ok(image);
        }
        let expected = opaque_bytes(view);
        self.pool.lock().reserve(expected, self.pool.byte_budget);
        let loaded = load_view_image(view);
        let mut state = self.pool.lock();
        state.num_reserved -= expected;
        state.num_misses += 1;
        let image = Arc::new(loaded?);
        Ok(if keep { state.insert(self.first + index, image, self.pool.byte_budget) } else { image })
    }

    /// Makes room for `num_bytes` that are held elsewhere, and says whether the budget has as many.
    pub(super) fn reserve(&self, num_bytes: usize) -> bool {
        let mut state = self.pool.lock();
        let fits = state.num_reserved + num_bytes <= self.pool.byte_budget;
        if fits {
            state.reserve(num_bytes, self.pool.byte_budget);
        }
        fits
    }

    /// Gives back what was reserved.
    pub(super) fn release(&self, num_bytes: usize) {
        self.pool.lock().num_reserved -= num_bytes;
    }

    /// Decodes images in parallel, in the order of the views, until all are held or the budget is full; returns how many
    /// of these views are held. `progress(done, planned)` is called from many threads after each image.
    ///
    /// # Errors
    /// Of the first view, in order, whose image does not load; as [`load_view_image`].
    pub fn preload(&self, progress: impl Fn(usize, usize) + Sync) -> Result<usize> {
        let planned = self.planned();
        let done = AtomicUsize::new(0);
        let results: Vec<Result<()>> = planned
            .par_iter()
            .map(|&index| {
                if self.pool.lock().slots[self.first + index].is_none() {
                    let image = Arc::new(load_view_image(&self.views[index])?);
                    let mut state = self.pool.lock();
                    state.num_misses += 1;
                    state.insert_if_room(self.first + index, image, self.pool.byte_budget);
                }
                progress(done.fetch_add(1, Ordering::Relaxed) + 1, planned.len());
                Ok(())
            })
            .collect();
        results.into_iter().collect::<Result<()>>()?;
        Ok(self.pool.lock().slots[self.slots()].iter().flatten().count())
    }

    /// Decodes view `index` in the background, on the thread pool of the caller, if it is not held. An error shows when the
    /// image is asked for with [`get`](Self::get).
    pub fn prefetch(self: &Arc<Self>, index: usize) {
        if index < self.len() && self.pool.lock().slots[self.first + index].is_none() {
            let cache = Arc::clone(self);
            rayon::spawn(move || drop(cache.get(index)));
        }
    }

    /// The first views that are held or whose pixels, without alpha and masks, fit what is left of the budget together.
    fn planned(&self) -> Vec<usize> {
        let state = self.pool.lock();
        let mut room = self.pool.byte_budget.saturating_sub(state.num_bytes + state.num_reserved);
        let fits = |&index: &usize| {
            let needed = if state.slots[self.first + index].is_some() { 0 } else { opaque_bytes(&self.views[index]) };
            let has_room = needed <= room;
            room = room.saturating_sub(needed);
            has_room
        };
        (0..self.views.len()).take_while(fits).collect()
    }

    fn slots(&self) -> Range<usize> {
        self.first..self.first + self.views.len()
    }
}

impl Drop for ImageCache {
    fn drop(&mut self) {
        // Another cache of this budget may live on.
        let mut state = self.pool.lock();
        self.slots().for_each(|slot| state.evict(slot));
    }
}

/// Bytes of the pixels of a view without alpha and mask.
fn opaque_bytes(view: &View) -> usize {
    let intrinsics = &view.camera.intrinsics;
    3 * intrinsics.width as usize * intrinsics.height as usize
}

impl Pool {
    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing that can panic runs under the lock, so that a poisoned state is still consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn hit(&mut self, slot: usize) -> Option<Arc<TrainingImage>> {
        let image = self.touch(slot)?;
        self.num_hits += 1;
        Some(image)
    }

    fn touch(&mut self, slot: usize) -> Option<Arc<TrainingImage>> {
        self.clock += 1;
        let slot = self.slots[slot].as_mut()?;
        slot.last_use = self.clock;
        Some(Arc::clone(&slot.image))
    }

    /// Sets `needed` bytes aside for an image that is to be decoded.
    fn reserve(&mut self, needed: usize, budget: usize) {
        self.make_room(needed, budget);
        self.num_reserved += needed;
        self.note_peak();
    }

    /// Drops the least recently used until `needed` bytes fit beside what is left, or nothing is.
    fn make_room(&mut self, needed: usize, budget: usize) {
        while self.num_bytes > 0 && self.num_bytes + self.num_reserved + needed > budget {
            let held = self.slots.iter().enumerate().filter_map(|(i, slot)| Some((slot.as_ref()?.last_use, i)));
            match held.min() {
                Some((_, oldest)) => self.evict(oldest),
                None => return,
            }
        }
    }

    fn note_peak(&mut self) {
        self.peak_bytes = self.peak_bytes.max(self.num_bytes + self.num_reserved);
    }

    /// Keeps `image`, if the budget has place for it at all, and returns the one that is kept.
    fn insert(&mut self, slot: usize, image: Arc<TrainingImage>, budget: usize) -> Arc<TrainingImage> {
        if let Some(held) = self.touch(slot) {
            return held;
        }
        if image.num_bytes() + self.num_reserved <= budget {
            self.make_room(image.num_bytes(), budget);
            self.insert_if_room(slot, Arc::clone(&image), budget);
        }
        image
    }

    fn insert_if_room(&mut self, slot: usize, image: Arc<TrainingImage>, budget: usize) {
        let needed = image.num_bytes();
        if self.slots[slot].is_none() && self.num_bytes + self.num_reserved + needed <= budget {
            self.clock += 1;
            self.num_bytes += needed;
            self.slots[slot] = Some(Slot { image, last_use: self.clock });
            self.note_peak();
        }
    }

    fn evict(&mut self, slot: usize) {
        if let Some(slot) = self.slots[slot].take() {
            self.num_bytes -= slot.image.num_bytes();
        }
    }
}
