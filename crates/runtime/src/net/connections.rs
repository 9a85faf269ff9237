//! Who is connected: as many as there is room for, and nobody for long who asks nothing.
//!
//! A connection counts as *waiting* until the first call of somebody who is known has come in. It has to come within
//! [`ConnectionLimits::first_call`], handshakes included, so sockets that say nothing, or say it slowly, are closed. One that
//! only asks what anybody may ask (health, reflection, a page for operators) may stay, but goes on waiting. When there is no
//! room the one that has waited longest makes way: a flood of idle sockets pushes itself out, and who has something to ask
//! still gets in.

use crate::net::in_flight::{Admission, FlightLimits};
use std::collections::{BTreeMap, HashMap};
use std::future::Future as _;
use std::io::{Error, ErrorKind, IoSlice};
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Sleep;
use tokio_stream::Stream;
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::transport::server::{Connected, TcpConnectInfo};

/// Files that a process needs besides its connections.
const OTHER_FILES: usize = 128;
/// What anybody may have in flight without saying who it is, by address: for probes and tools.
const GUESTS: FlightLimits = FlightLimits { calls: 256, streams: 64, caller_bytes: 1 << 20, bytes: 16 << 20 };
/// How long nobody is accepted after the system refused to (no files are left).
const PAUSE: Duration = Duration::from_millis(100);

/// What a connection has asked for so far: nothing; what anybody may ask; what callers who are known ask.
const SILENT: u8 = 0;
const PROBED: u8 = 1;
const CALLED: u8 = 2;

/// How many connections a server has, and how patient it is with new ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// Of everybody.
    pub total: usize,
    /// From one address.
    pub per_peer: usize,
    /// A connection whose first call has not come after this time is closed.
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
    guests: Arc<Admission>,
}

#[derive(Debug, Default)]
struct Table {
    open: HashMap<SocketAddr, Entry>,
    /// Those without a call, by age.
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

impl Connections {
    fn new(limits: ConnectionLimits) -> Self {
        let files = crate::process::open_files().saturating_sub(OTHER_FILES).max(1);
        if files < limits.total {
            tracing::debug!(files, "fewer connections than configured: the system allows no more open files");
        }
        let total = limits.total.min(files);
        let limits = ConnectionLimits { total, per_peer: limits.per_peer.min(total), ..limits };
        // They are answered while the service drains: that is what they ask about.
        Self { limits, table: Arc::default(), guests: Admission::new(GUESTS, CancellationToken::new()) }
    }

    /// Somebody who is known called on the connection from this address: it makes way for nobody.
    pub fn called(&self, address: SocketAddr) {
        let mut table = self.lock();
        let Some(entry) = table.open.get(&address) else { return };
        if entry.state.swap(CALLED, Ordering::Relaxed) != CALLED {
            let number = entry.number;
            table.waiting.remove(&number);
        }
    }

    /// Somebody asked what anybody may ask: the connection stays until there is no room.
    pub fn probed(&self, address: SocketAddr) {
        if let Some(entry) = self.lock().open.get(&address) {
            entry.state.fetch_max(PROBED, Ordering::Relaxed);
        }
    }

    /// What those have in flight who need not say who they are.
    pub fn guests(&self) -> &Arc<Admission> {
        &self.guests
    }

    /// Connections that are open.
    pub fn open(&self) -> usize {
        self.lock().open.len()
    }

    /// A place for one more, or `None` when every place is taken by somebody who has asked for something.
    fn admit(&self, address: SocketAddr) -> Option<Place> {
        let mut table = self.lock();
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
        // The system gives the same address again only after the old connection is gone; its place may still be there.
        table.close(address);
        table.open.insert(address, Entry { number, state: state.clone(), close: close.clone() });
        table.waiting.insert(number, address);
        *table.peers.entry(address.ip()).or_default() += 1;
        drop(table);
        let patience = Box::pin(tokio::time::sleep(self.limits.first_call));
        let closed = Box::pin(close.cancelled_owned());
        Some(Place { connections: self.clone(), address, number, state, patience, closed })
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        // Counting cannot fail half-way.
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Table {
    /// Takes a connection off the list and tells it to end.
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

/// A connection's place on the list; free again when dropped.
#[derive(Debug)]
struct Place {
    connections: Connections,
    address: SocketAddr,
    number: u64,
    state: Arc<AtomicU8>,
    patience: Pin<Box<Sleep>>,
    closed: Pin<Box<WaitForCancellationFutureOwned>>,
}

impl Place {
    /// Fails once a connection that has asked for nothing has to go.
    fn check(&mut self, cx: &mut Context<'_>) -> Result<(), Error> {
        let state = self.state.load(Ordering::Relaxed);
        if state == CALLED {
            return Ok(());
        }
        if self.closed.as_mut().poll(cx).is_ready() {
            return Err(Error::new(ErrorKind::ConnectionAborted, "made way for another connection"));
        }
        if state == SILENT && self.patience.as_mut().poll(cx).is_ready() {
            return Err(Error::new(ErrorKind::TimedOut, "no call came"));
        }
        Ok(())
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut table = self.connections.lock();
        if table.open.get(&self.address).is_some_and(|entry| entry.number == self.number) {
            table.close(self.address);
        }
    }
}

/// A connection that has a place.
#[derive(Debug)]
pub struct Connection {
    stream: TcpStream,
    place: Place,
}

impl Connected for Connection {
    type ConnectInfo = TcpConnectInfo;

    fn connect_info(&self) -> TcpConnectInfo {
        self.stream.connect_info()
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<Result<(), Error>> {
        self.place.check(cx)?;
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<Result<usize, Error>> {
        self.place.check(cx)?;
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<Result<usize, Error>> {
        self.place.check(cx)?;
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

/// What a listener accepts, as far as there is room. Never ends by itself: a system that refuses is asked again.
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

    /// The same listener within other limits; before the first connection.
    #[must_use]
    pub fn within(self, limits: ConnectionLimits) -> Self {
        Self::new(self.listener, limits)
    }

    /// The list that these connections are on.
    pub fn connections(&self) -> Connections {
        self.connections.clone()
    }

    fn take(&self, stream: TcpStream, address: SocketAddr) -> Option<Connection> {
        let Some(place) = self.connections.admit(address) else {
            tracing::debug!(peer = %address, "no room for another connection");
            return None;
        };
        // Without Nagle's delay. One that is gone already is noticed with its first read.
        let _ = stream.set_nodelay(true);
        Some(Connection { stream, place })
    }
}

impl axum::serve::Listener for Incoming {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        loop {
            // Never ends, and never fails: see the stream.
            if let Some(Ok(connection)) = std::future::poll_fn(|cx| Pin::new(&mut *self).poll_next(cx)).await {
                let address = connection.place.address;
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
                Ok((stream, address)) => {
                    if let Some(connection) = self.take(stream, address) {
                        return Poll::Ready(Some(Ok(connection)));
                    }
                }
                Err(error) => {
                    tracing::warn!(%error, "a connection could not be accepted");
                    self.pause = Some(Box::pin(tokio::time::sleep(PAUSE)));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(host: u8, port: u16) -> SocketAddr {
        ([127, 0, 0, host], port).into()
    }

    fn gone(place: &mut Place) -> bool {
        place.check(&mut Context::from_waker(std::task::Waker::noop())).is_err()
    }

    #[tokio::test]
    async fn who_waits_longest_makes_way_and_who_has_called_stays() {
        let limits = ConnectionLimits { total: 3, per_peer: 2, first_call: Duration::from_secs(60) };
        let connections = Connections::new(limits);
        let mut first = connections.admit(address(1, 1)).unwrap();
        let mut second = connections.admit(address(1, 2)).unwrap();
        // The peer's own oldest goes.
        let mut third = connections.admit(address(1, 3)).unwrap();
        assert_eq!([gone(&mut first), gone(&mut second), gone(&mut third)], [true, false, false]);
        drop(first);
        assert_eq!(connections.open(), 2);
        connections.called(address(1, 2));
        connections.called(address(1, 3));
        assert!(connections.admit(address(1, 4)).is_none(), "both places of this peer are at work");
        // Somebody else still gets in, and the total counts for all.
        let mut other = connections.admit(address(2, 1)).unwrap();
        let another = connections.admit(address(3, 1)).unwrap();
        assert!(gone(&mut other) && !gone(&mut second) && !gone(&mut third));
        drop((second, third, other, another));
        assert_eq!(connections.open(), 0);
        assert!(connections.lock().peers.is_empty() && connections.lock().waiting.is_empty());
    }

    #[tokio::test]
    async fn a_first_call_has_to_come_in_time() {
        let first_call = Duration::from_millis(50);
        let connections = Connections::new(ConnectionLimits { first_call, ..ConnectionLimits::default() });
        let (mut mute, mut busy) =
            (connections.admit(address(1, 1)).unwrap(), connections.admit(address(1, 2)).unwrap());
        connections.called(address(1, 2));
        tokio::time::sleep(2 * first_call).await;
        assert!(gone(&mut mute) && !gone(&mut busy));
    }

    #[tokio::test]
    async fn who_only_probes_stays_until_there_is_no_room() {
        let limits = ConnectionLimits { total: 2, per_peer: 2, first_call: Duration::from_millis(50) };
        let connections = Connections::new(limits);
        let (mut probe, mut known) =
            (connections.admit(address(1, 1)).unwrap(), connections.admit(address(1, 2)).unwrap());
        connections.probed(address(1, 1));
        connections.called(address(1, 2));
        // A probe of somebody who is known takes nothing away.
        connections.probed(address(1, 2));
        tokio::time::sleep(2 * limits.first_call).await;
        assert!(!gone(&mut probe) && !gone(&mut known));
        let _another = connections.admit(address(1, 3)).unwrap();
        assert!(gone(&mut probe) && !gone(&mut known));
    }
}
