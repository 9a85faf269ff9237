//! Connection table: limits in total and per peer, and the time to the first call ([`ConnectionLimits::first_call`]).
//!
//! A connection is `Silent` until its first call, `Probed` after a call to a public service (health, reflection, the HTTP
//! page), and `Called` after an authenticated call. A `Silent` connection is closed after `first_call`, handshakes included.
//! At a limit, the oldest connection that is not yet `Called` is evicted for the new one, so that a flood of idle sockets
//! evicts itself and callers with credentials still get in. A `Called` connection is never evicted.

use crate::net::in_flight::{InFlight, InFlightLimits};
use crate::sync::lock;
use std::collections::{BTreeMap, HashMap};
use std::future::Future as _;
use std::io::{Error, ErrorKind, IoSlice};
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Sleep;
use tokio_stream::Stream;
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

/// Files that a process needs besides its connections; half of them if there are few, but not less than it cannot do without.
const OTHER_FILES: usize = 128;
const LEAST_FILES: usize = 24;
/// What one address may have in flight without credentials: for probes and tools.
const ANONYMOUS: InFlightLimits = InFlightLimits { calls: 256, streams: 64, caller_bytes: 1 << 20, bytes: 16 << 20 };
/// Pause after a failed accept (no file descriptors are left).
const PAUSE: Duration = Duration::from_millis(100);

/// What a connection has sent so far: no call, a call to a public service, or an authenticated call. A state is only ever raised,
/// and a socket reads its own with every read and write, without the lock of the table.
const SILENT: u8 = 0;
const PROBED: u8 = 1;
const CALLED: u8 = 2;

/// Limits of the connections of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// Connections of all peers.
    pub total: usize,
    /// Connections from one IP address.
    pub per_peer: usize,
    /// A connection without a call after this time is closed.
    pub first_call: Duration,
}

impl Default for ConnectionLimits {
    fn default() -> Self {
        Self { total: 2048, per_peer: 1024, first_call: Duration::from_secs(10) }
    }
}

/// The connections of one server.
#[derive(Debug, Clone)]
pub struct Connections {
    limits: ConnectionLimits,
    table: Arc<Mutex<Table>>,
    anonymous: Arc<InFlight>,
}

#[derive(Debug, Default)]
struct Table {
    open: HashMap<SocketAddr, Entry>,
    /// Connections that may be evicted (not `Called`), oldest first.
    waiting: BTreeMap<u64, SocketAddr>,
    peers: HashMap<IpAddr, usize>,
    next: u64,
}

#[derive(Debug)]
struct Entry {
    number: u64,
    state: Arc<AtomicU8>,
    close: CancellationToken,
}

/// How many of the files that a process may open are for connections.
fn for_connections(files: usize) -> usize {
    files.saturating_sub((files / 2).clamp(LEAST_FILES, OTHER_FILES)).max(1)
}

impl Connections {
    fn new(limits: ConnectionLimits) -> Self {
        let files = for_connections(crate::process::open_files());
        if files < limits.total {
            tracing::debug!(files, "connection limit lowered to the limit of open files");
        }
        let total = limits.total.min(files);
        let limits = ConnectionLimits { total, per_peer: limits.per_peer.min(total), ..limits };
        // Never drains: probes must get an answer while the service drains.
        Self { limits, table: Arc::default(), anonymous: InFlight::new(ANONYMOUS, CancellationToken::new()) }
    }

    /// An authenticated call arrived on the connection from this address: it is no longer evicted.
    pub fn called(&self, address: SocketAddr) {
        let mut table = lock(&self.table);
        let Some(entry) = table.open.get(&address) else { return };
        entry.state.store(CALLED, Ordering::Relaxed);
        let number = entry.number;
        table.waiting.remove(&number);
    }

    /// A call to a public service arrived: the connection stays until it is evicted.
    pub fn probed(&self, address: SocketAddr) {
        if let Some(entry) = lock(&self.table).open.get(&address) {
            entry.state.fetch_max(PROBED, Ordering::Relaxed);
        }
    }

    /// What callers of public services have in flight, by address.
    pub fn anonymous(&self) -> &Arc<InFlight> {
        &self.anonymous
    }

    /// Adds a connection; `None` at a limit when no connection can be evicted.
    fn admit(&self, address: SocketAddr) -> Option<Slot> {
        let mut table = lock(&self.table);
        let of_peer = |table: &Table| table.peers.get(&address.ip()).copied().unwrap_or(0);
        if of_peer(&table) >= self.limits.per_peer {
            let oldest = table.waiting.values().copied().find(|waiting| waiting.ip() == address.ip())?;
            table.close(oldest);
        } else if table.open.len() >= self.limits.total {
            let oldest = table.waiting.values().copied().next()?;
            table.close(oldest);
        }
        let (number, state, close) = (table.next, Arc::new(AtomicU8::new(SILENT)), CancellationToken::new());
        table.next += 1;
        // The system reuses an address only after the old connection has ended; its entry may still be there.
        table.close(address);
        table.open.insert(address, Entry { number, state: state.clone(), close: close.clone() });
        table.waiting.insert(number, address);
        *table.peers.entry(address.ip()).or_default() += 1;
        drop(table);
        let first_call = Box::pin(tokio::time::sleep(self.limits.first_call));
        let evicted = Box::pin(close.cancelled_owned());
        Some(Slot { connections: self.clone(), address, number, state, first_call, evicted })
    }
}

impl Table {
    /// Removes a connection and closes it.
    fn close(&mut self, address: SocketAddr) {
        let Some(entry) = self.open.remove(&address) else { return };
        self.waiting.remove(&entry.number);
        entry.close.cancel();
        if let Some(count) = self.peers.get_mut(&address.ip()) {
            *count -= 1;
            if *count == 0 {
                self.peers.remove(&address.ip());
            }
        }
    }
}

/// A connection's entry in the table; removed when dropped.
#[derive(Debug)]
struct Slot {
    connections: Connections,
    address: SocketAddr,
    number: u64,
    state: Arc<AtomicU8>,
    first_call: Pin<Box<Sleep>>,
    evicted: Pin<Box<WaitForCancellationFutureOwned>>,
}

impl Slot {
    /// Fails once the connection was evicted or has sent no call in time.
    fn check(&mut self, cx: &mut Context<'_>) -> Result<(), Error> {
        let state = self.state.load(Ordering::Relaxed);
        if state == CALLED {
            return Ok(());
        }
        if self.evicted.as_mut().poll(cx).is_ready() {
            return Err(Error::new(ErrorKind::ConnectionAborted, "evicted at the connection limit"));
        }
        if state == SILENT && self.first_call.as_mut().poll(cx).is_ready() {
            return Err(Error::new(ErrorKind::TimedOut, "no call arrived in time"));
        }
        Ok(())
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        let mut table = lock(&self.connections.table);
        if table.open.get(&self.address).is_some_and(|entry| entry.number == self.number) {
            table.close(self.address);
        }
    }
}

/// A connection with an entry in the table.
#[derive(Debug)]
pub struct Connection {
    stream: TcpStream,
    slot: Slot,
}

impl Connection {
    /// The peer's address.
    pub(crate) fn address(&self) -> SocketAddr {
        self.slot.address
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<Result<(), Error>> {
        self.slot.check(cx)?;
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<Result<usize, Error>> {
        self.slot.check(cx)?;
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<Result<usize, Error>> {
        self.slot.check(cx)?;
        Pin::new(&mut self.stream).poll_write_vectored(cx, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Result<(), Error>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Result<(), Error>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

/// The connections of a listener, within limits. Never ends by itself: a failed accept is retried.
#[derive(Debug)]
pub struct Incoming {
    listener: TcpListener,
    connections: Connections,
    pause: Option<Pin<Box<Sleep>>>,
}

impl Incoming {
    /// The connections of a listener, within limits.
    pub fn new(listener: TcpListener, limits: ConnectionLimits) -> Self {
        Self { listener, connections: Connections::new(limits), pause: None }
    }

    /// The same listener with other limits; before the first connection.
    #[must_use]
    pub fn within(self, limits: ConnectionLimits) -> Self {
        Self::new(self.listener, limits)
    }

    /// The table of these connections.
    pub fn connections(&self) -> Connections {
        self.connections.clone()
    }
}

impl axum::serve::Listener for Incoming {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        loop {
            // The stream below never ends and never fails.
            if let Some(Ok(connection)) = std::future::poll_fn(|cx| Pin::new(&mut *self).poll_next(cx)).await {
                let address = connection.address();
                return (connection, address);
            }
        }
    }

    fn local_addr(&self) -> Result<SocketAddr, Error> {
        self.listener.local_addr()
    }
}

impl Stream for Incoming {
    type Item = Result<Connection, Error>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        loop {
            if let Some(pause) = &mut self.pause {
                std::task::ready!(pause.as_mut().poll(cx));
                self.pause = None;
            }
            match std::task::ready!(self.listener.poll_accept(cx)) {
                Ok((stream, address)) => match self.connections.admit(address) {
                    Some(slot) => {
                        // Without Nagle's delay. A connection that is already closed fails with its first read.
                        let _ = stream.set_nodelay(true);
                        return Poll::Ready(Some(Ok(Connection { stream, slot })));
                    }
                    None => tracing::debug!(peer = %address, "connection limit reached; connection rejected"),
                },
                Err(error) => {
                    tracing::warn!(%error, "accept failed");
                    self.pause = Some(Box::pin(tokio::time::sleep(PAUSE)));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Connections {
        pub(crate) fn open(&self) -> usize {
            lock(&self.table).open.len()
        }
    }

    fn address(host: u8, port: u16) -> SocketAddr {
        ([127, 0, 0, host], port).into()
    }

    fn closed(slot: &mut Slot) -> bool {
        slot.check(&mut Context::from_waker(std::task::Waker::noop())).is_err()
    }

    #[test]
    fn few_open_files_leave_room_for_a_training() {
        assert_eq!([20, 32, 48, 64, 128, 1024].map(for_connections), [1, 8, 24, 32, 64, 896]);
    }

    #[tokio::test]
    async fn at_a_limit_the_oldest_silent_connection_is_evicted_and_a_called_one_stays() {
        let limits = ConnectionLimits { total: 3, per_peer: 2, first_call: Duration::from_secs(60) };
        let connections = Connections::new(limits);
        let mut first = connections.admit(address(1, 1)).unwrap();
        let mut second = connections.admit(address(1, 2)).unwrap();
        // The peer's own oldest is evicted.
        let mut third = connections.admit(address(1, 3)).unwrap();
        assert_eq!([closed(&mut first), closed(&mut second), closed(&mut third)], [true, false, false]);
        drop(first);
        assert_eq!(connections.open(), 2);
        connections.called(address(1, 2));
        connections.called(address(1, 3));
        assert!(connections.admit(address(1, 4)).is_none(), "both connections of this peer have called");
        // Another peer still gets in, and the total counts for all.
        let mut other = connections.admit(address(2, 1)).unwrap();
        let another = connections.admit(address(3, 1)).unwrap();
        assert!(closed(&mut other) && !closed(&mut second) && !closed(&mut third));
        drop((second, third, other, another));
        assert_eq!(connections.open(), 0);
        assert!(lock(&connections.table).peers.is_empty() && lock(&connections.table).waiting.is_empty());
    }

    #[tokio::test]
    async fn a_connection_without_a_call_is_closed_in_time() {
        let first_call = Duration::from_millis(50);
        let connections = Connections::new(ConnectionLimits { first_call, ..ConnectionLimits::default() });
        let (mut mute, mut busy) =
            (connections.admit(address(1, 1)).unwrap(), connections.admit(address(1, 2)).unwrap());
        connections.called(address(1, 2));
        tokio::time::sleep(2 * first_call).await;
        assert!(closed(&mut mute) && !closed(&mut busy));
    }

    #[tokio::test]
    async fn a_probed_connection_stays_until_it_is_evicted() {
        let limits = ConnectionLimits { total: 2, per_peer: 2, first_call: Duration::from_millis(50) };
        let connections = Connections::new(limits);
        let (mut probe, mut known) =
            (connections.admit(address(1, 1)).unwrap(), connections.admit(address(1, 2)).unwrap());
        connections.probed(address(1, 1));
        connections.called(address(1, 2));
        // A probe does not lower the state.
        connections.probed(address(1, 2));
        tokio::time::sleep(2 * limits.first_call).await;
        assert!(!closed(&mut probe) && !closed(&mut known));
        let _another = connections.admit(address(1, 3)).unwrap();
        assert!(closed(&mut probe) && !closed(&mut known));
    }
}
