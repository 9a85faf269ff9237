//! Limits of what each caller, and all callers together, have in flight; while the service drains every call is rejected.

use crate::net::auth::Caller;
use crate::status;
use crate::sync::lock;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Retry delay when a limit is reached.
const BUSY: Duration = Duration::from_millis(100);
/// Retry delay while the service stops; by then another instance may have replaced it.
const STOPPING: Duration = Duration::from_secs(1);

/// The two kinds of calls, which have limits of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CallKind {
    /// Unary: counted until its response is sent.
    Call,
    /// Streaming: counted until the stream closes.
    Stream,
}

/// Limits of what may be in flight.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InFlightLimits {
    /// Unary calls of one caller.
    pub calls: usize,
    /// Open streams of one caller.
    pub streams: usize,
    /// Bytes of request messages of one caller.
    pub caller_bytes: usize,
    /// Bytes of request messages of all callers.
    pub bytes: usize,
}

/// Counts what every caller has in flight.
#[derive(Debug)]
pub struct InFlight {
    usage: Mutex<Usage>,
    limits: InFlightLimits,
    draining: CancellationToken,
}

#[derive(Debug, Default)]
struct Usage {
    callers: HashMap<Arc<str>, CallerUsage>,
    bytes: usize,
}

#[derive(Debug, Default, PartialEq, Eq)]
struct CallerUsage {
    /// Unary calls, streams: by [`CallKind`].
    counts: [usize; 2],
    bytes: usize,
}

impl InFlight {
    /// Accepts calls until `draining` is cancelled.
    pub fn new(limits: InFlightLimits, draining: CancellationToken) -> Arc<Self> {
        Arc::new(Self { usage: Mutex::default(), limits, draining })
    }

    /// Counts one more call, until the permit is dropped.
    /// At the limit: RESOURCE_EXHAUSTED; while the service drains: UNAVAILABLE.
    pub fn acquire(self: &Arc<Self>, caller: &Caller, kind: CallKind) -> Result<Permit, Status> {
        self.check_open()?;
        let limit = if kind == CallKind::Call { self.limits.calls } else { self.limits.streams };
        let mut usage = lock(&self.usage);
        let count = &mut usage.callers.entry(caller.name.clone()).or_default().counts[kind as usize];
        if *count >= limit {
            let what = if kind == CallKind::Call { "calls in flight" } else { "open streams" };
            let problem = format!("caller '{}' is at its limit of {limit} {what}; retry later", caller.name);
            return Err(status::resource_exhausted(problem, BUSY));
        }
        *count += 1;
        drop(usage);
        Ok(Permit { in_flight: self.clone(), name: caller.name.clone(), kind, bytes: Mutex::new(0) })
    }

    /// Rejects calls while the service drains.
    pub fn check_open(&self) -> Result<(), Status> {
        if self.draining.is_cancelled() { Err(stopping()) } else { Ok(()) }
    }

    /// Calls of a kind in flight, of all callers.
    pub fn count(&self, kind: CallKind) -> usize {
        lock(&self.usage).callers.values().map(|caller| caller.counts[kind as usize]).sum()
    }
}

/// The status that ends streams when the service drains.
pub fn stopping() -> Status {
    status::unavailable("the service is stopping", STOPPING)
}

/// One call in flight; released when dropped.
#[derive(Debug)]
pub struct Permit {
    in_flight: Arc<InFlight>,
    name: Arc<str>,
    kind: CallKind,
    /// Length of the message that arrives or is processed.
    bytes: Mutex<usize>,
}

impl Permit {
    /// Counts a message of this length, which replaces the previous message of the call. Beyond a limit: RESOURCE_EXHAUSTED.
    pub fn reserve(&self, length: usize) -> Result<(), Status> {
        let mut own = lock(&self.bytes);
        let limits = &self.in_flight.limits;
        let mut usage = lock(&self.in_flight.usage);
        let before = std::mem::take(&mut *own);
        usage.bytes -= before;
        let all = usage.bytes + length;
        let caller = usage.callers.entry(self.name.clone()).or_default();
        caller.bytes -= before;
        if caller.bytes + length > limits.caller_bytes || all > limits.bytes {
            let (whose, used, limit) = match all > limits.bytes {
                true => ("of all callers".to_owned(), all - length, limits.bytes),
                false => (format!("of caller '{}'", self.name), caller.bytes, limits.caller_bytes),
            };
            let problem = format!(
                "message of {length} bytes exceeds the in-flight budget {whose} ({used} of {limit} bytes used)"
            );
            return Err(status::resource_exhausted(problem, BUSY));
        }
        caller.bytes += length;
        usage.bytes = all;
        *own = length;
        Ok(())
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let own = *self.bytes.get_mut().unwrap_or_else(PoisonError::into_inner);
        let mut usage = lock(&self.in_flight.usage);
        usage.bytes -= own;
        if let Some(caller) = usage.callers.get_mut(&self.name) {
            caller.counts[self.kind as usize] = caller.counts[self.kind as usize].saturating_sub(1);
            caller.bytes -= own;
            if *caller == CallerUsage::default() {
                usage.callers.remove(&self.name);
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

    const LIMITS: InFlightLimits = InFlightLimits { calls: 2, streams: 1, caller_bytes: 100, bytes: 150 };

    #[test]
    fn permits_are_counted_per_caller_and_released() {
        let draining = CancellationToken::new();
        let in_flight = InFlight::new(LIMITS, draining.clone());
        let first = in_flight.acquire(&caller("a"), CallKind::Call).unwrap();
        let _second = in_flight.acquire(&caller("a"), CallKind::Call).unwrap();
        let refused = in_flight.acquire(&caller("a"), CallKind::Call).unwrap_err();
        assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
        assert!(status::retry_delay(&refused).is_some());
        let _other = in_flight.acquire(&caller("b"), CallKind::Call).unwrap();
        let _stream = in_flight.acquire(&caller("a"), CallKind::Stream).unwrap();
        assert!(in_flight.acquire(&caller("a"), CallKind::Stream).is_err());
        drop(first);
        let _third = in_flight.acquire(&caller("a"), CallKind::Call).unwrap();
        assert_eq!(in_flight.count(CallKind::Call), 3);
        draining.cancel();
        assert_eq!(in_flight.acquire(&caller("c"), CallKind::Call).unwrap_err().code(), tonic::Code::Unavailable);
    }

    #[test]
    fn bytes_are_counted_before_they_arrive() {
        let in_flight = InFlight::new(LIMITS, CancellationToken::new());
        let acquire = |name| in_flight.acquire(&caller(name), CallKind::Call).unwrap();
        let (a, second, b) = (acquire("a"), acquire("a"), acquire("b"));
        a.reserve(60).unwrap();
        let refused = second.reserve(41).unwrap_err();
        assert!(status::retry_delay(&refused).is_some() && refused.message().contains("'a'"), "{refused}");
        second.reserve(40).unwrap();
        assert!(b.reserve(51).unwrap_err().message().contains("of all callers (100 of 150"));
        // The next message of a stream replaces the previous one.
        a.reserve(10).unwrap();
        b.reserve(100).unwrap();
        drop((a, second, b));
        let usage = lock(&in_flight.usage);
        assert!(usage.bytes == 0 && usage.callers.is_empty());
    }
}
