//! Who is let in now: nobody while the service drains, and nobody with too much in flight already.

use crate::net::auth::Caller;
use crate::status;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// When to come back to a service that has too much to do.
const BUSY: Duration = Duration::from_millis(100);
/// When to come back to a service that stops; another may have taken its place by then.
const STOPPING: Duration = Duration::from_secs(1);

/// What a caller holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A request until its answer.
    Call,
    /// A stream that stays open.
    Stream,
}

/// How much may be in flight.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FlightLimits {
    /// Calls of one caller.
    pub calls: usize,
    /// Open streams of one caller.
    pub streams: usize,
    /// Bytes of messages of one caller.
    pub caller_bytes: usize,
    /// Bytes of messages of everybody.
    pub bytes: usize,
}

/// Counts what every caller has in flight.
#[derive(Debug)]
pub struct Admission {
    flights: Mutex<Flights>,
    limits: FlightLimits,
    draining: CancellationToken,
}

#[derive(Debug, Default)]
struct Flights {
    held: HashMap<Arc<str>, Held>,
    bytes: usize,
}

#[derive(Debug, Default, PartialEq, Eq)]
struct Held {
    /// Calls, streams.
    counts: [usize; 2],
    bytes: usize,
}

impl Admission {
    /// Lets calls in until `draining` is cancelled.
    pub fn new(limits: FlightLimits, draining: CancellationToken) -> Arc<Self> {
        Arc::new(Self { flights: Mutex::default(), limits, draining })
    }

    /// Lets one more in, until the slot is dropped.
    ///
    /// # Errors
    /// RESOURCE_EXHAUSTED: the caller has as much in flight as it may. UNAVAILABLE: the service drains.
    pub fn enter(self: &Arc<Self>, caller: &Caller, kind: Kind) -> Result<Slot, Status> {
        self.check_open()?;
        let limit = if kind == Kind::Call { self.limits.calls } else { self.limits.streams };
        let mut flights = self.lock();
        let count = &mut flights.held.entry(caller.name.clone()).or_default().counts[kind as usize];
        if *count >= limit {
            let what = if kind == Kind::Call { "calls in flight" } else { "open streams" };
            return Err(status::resource_exhausted(format!("'{}' has {limit} {what} already", caller.name), BUSY));
        }
        *count += 1;
        drop(flights);
        Ok(Slot { admission: self.clone(), name: caller.name.clone(), kind, bytes: Mutex::new(0) })
    }

    /// Refuses when the service drains.
    ///
    /// # Errors
    /// UNAVAILABLE.
    pub fn check_open(&self) -> Result<(), Status> {
        if self.draining.is_cancelled() { Err(stopping()) } else { Ok(()) }
    }

    /// What everybody holds of a kind.
    pub fn count(&self, kind: Kind) -> usize {
        self.lock().held.values().map(|held| held.counts[kind as usize]).sum()
    }

    fn lock(&self) -> MutexGuard<'_, Flights> {
        // Counting cannot fail half-way.
        self.flights.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What a stream ends with when the service drains.
pub fn stopping() -> Status {
    status::unavailable("the service is stopping", STOPPING)
}

/// A place; free again when dropped.
#[derive(Debug)]
pub struct Slot {
    admission: Arc<Admission>,
    name: Arc<str>,
    kind: Kind,
    /// Of the message that is on its way or at work.
    bytes: Mutex<usize>,
}

impl Slot {
    /// A message of this length begins to arrive, in place of the one before it.
    ///
    /// # Errors
    /// RESOURCE_EXHAUSTED: so much is on its way already.
    pub fn announce(&self, length: usize) -> Result<(), Status> {
        let mut own = self.bytes.lock().unwrap_or_else(PoisonError::into_inner);
        let limits = &self.admission.limits;
        let mut flights = self.admission.lock();
        let before = std::mem::take(&mut *own);
        flights.bytes -= before;
        let all = flights.bytes + length;
        let held = flights.held.entry(self.name.clone()).or_default();
        held.bytes -= before;
        if held.bytes + length > limits.caller_bytes || all > limits.bytes {
            let whose = if all > limits.bytes { "everybody" } else { &*self.name };
            let problem = format!("{length} bytes are more than there is room for beside what '{whose}' has in flight");
            return Err(status::resource_exhausted(problem, BUSY));
        }
        held.bytes += length;
        flights.bytes = all;
        *own = length;
        Ok(())
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        let own = *self.bytes.get_mut().unwrap_or_else(PoisonError::into_inner);
        let mut flights = self.admission.lock();
        flights.bytes -= own;
        if let Some(held) = flights.held.get_mut(&self.name) {
            held.counts[self.kind as usize] = held.counts[self.kind as usize].saturating_sub(1);
            held.bytes -= own;
            if *held == Held::default() {
                flights.held.remove(&self.name);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::auth::Role;

    fn caller(name: &str) -> Caller {
        Caller { name: name.into(), role: Role::Client }
    }

    const LIMITS: FlightLimits = FlightLimits { calls: 2, streams: 1, caller_bytes: 100, bytes: 150 };

    #[test]
    fn places_are_counted_per_caller_and_come_back() {
        let draining = CancellationToken::new();
        let admission = Admission::new(LIMITS, draining.clone());
        let first = admission.enter(&caller("a"), Kind::Call).unwrap();
        let _second = admission.enter(&caller("a"), Kind::Call).unwrap();
        let refused = admission.enter(&caller("a"), Kind::Call).unwrap_err();
        assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
        assert!(status::retry_delay(&refused).is_some());
        let _other = admission.enter(&caller("b"), Kind::Call).unwrap();
        let _stream = admission.enter(&caller("a"), Kind::Stream).unwrap();
        assert!(admission.enter(&caller("a"), Kind::Stream).is_err());
        drop(first);
        let _third = admission.enter(&caller("a"), Kind::Call).unwrap();
        assert_eq!(admission.count(Kind::Call), 3);
        draining.cancel();
        assert_eq!(admission.enter(&caller("c"), Kind::Call).unwrap_err().code(), tonic::Code::Unavailable);
    }

    #[test]
    fn bytes_are_counted_from_their_announcement() {
        let admission = Admission::new(LIMITS, CancellationToken::new());
        let enter = |name| admission.enter(&caller(name), Kind::Call).unwrap();
        let (a, second, b) = (enter("a"), enter("a"), enter("b"));
        a.announce(60).unwrap();
        let refused = second.announce(41).unwrap_err();
        assert!(status::retry_delay(&refused).is_some() && refused.message().contains("'a'"), "{refused}");
        second.announce(40).unwrap();
        assert!(b.announce(51).unwrap_err().message().contains("'everybody'"));
        // The next message of a stream takes the place of the one before it.
        a.announce(10).unwrap();
        b.announce(100).unwrap();
        drop((a, second, b));
        let flights = admission.lock();
        assert!(flights.bytes == 0 && flights.held.is_empty());
    }
}
