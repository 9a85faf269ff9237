//! Working memory that is used again: a fresh vector of this size costs as much as a layer, because every page of it is zeroed
//! and most of them by the kernel.

use std::cell::RefCell;
use std::ops::{Deref, DerefMut};

/// Bytes of a line of the caches: vectors that begin on one cross none.
const LINE: usize = 64;

/// Vectors that a thread keeps.
const KEPT: usize = 24;

thread_local! {
    static FREE: RefCell<Vec<Vec<f32>>> = const { RefCell::new(Vec::new()) };
}

/// Numbers of no account: a buffer is written before it is read. It begins on a line of the caches.
#[derive(Default)]
pub(crate) struct Buffer {
    values: Vec<f32>,
    start: usize,
    len: usize,
}

impl Buffer {
    /// The smallest kept vector that is large enough, or a new one.
    pub(crate) fn take(len: usize) -> Self {
        let room = len + LINE / size_of::<f32>();
        let kept = FREE.with_borrow_mut(|free| {
            let fits = free.iter().enumerate().filter(|(_, v)| v.capacity() >= room);
            let best = fits.min_by_key(|(_, v)| v.capacity()).map(|(at, _)| at);
            best.map(|at| free.swap_remove(at))
        });
        let mut values = kept.unwrap_or_default();
        if values.len() < room {
            values.resize(room, 0.0);
        }
        let start = values.as_ptr().align_offset(LINE).min(room - len);
        Self { values, start, len }
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        let values = std::mem::take(&mut self.values);
        if values.is_empty() {
            return;
        }
        // A thread that ends has no list any more.
        let _ = FREE.try_with(|free| {
            let Ok(mut free) = free.try_borrow_mut() else { return };
            if free.len() >= KEPT
                && let Some(least) = free.iter().enumerate().min_by_key(|(_, v)| v.capacity()).map(|(at, _)| at)
            {
                free.swap_remove(least);
            }
            free.push(values);
        });
    }
}

impl Deref for Buffer {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.values[self.start..self.start + self.len]
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.values[self.start..self.start + self.len]
    }
}
