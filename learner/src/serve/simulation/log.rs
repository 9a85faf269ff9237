//! Counts what the product says in its log.

use std::cell::Cell;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::subscriber::with_default;
use tracing::{Event, Metadata, Subscriber};

thread_local! {
    static STALLS: Cell<u64> = const { Cell::new(0) };
}

/// Lines about a stalled lease since the beginning of [`capture`].
pub(super) fn stalls() -> u64 {
    STALLS.get()
}

pub(super) fn capture<T>(play: impl FnOnce() -> T) -> T {
    STALLS.set(0);
    with_default(Counter, play)
}

struct Counter;

impl Subscriber for Counter {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.is_event()
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, event: &Event<'_>) {
        event.record(&mut Line);
    }

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

struct Line;

impl Visit for Line {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        if field.name() == "message" && format!("{value:?}").contains("much longer than usual") {
            STALLS.set(STALLS.get() + 1);
        }
    }
}
