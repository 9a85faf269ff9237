//! A network that misbehaves: a TCP relay between a client and a server whose faults a test turns on and off.

use magex_core::rng::{Key, Purpose, Stream};
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

/// What goes wrong. The default is nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Faults {
    /// Everything that is said arrives so much later.
    pub delay: Duration,
    /// Bandwidth of each direction of each connection.
    pub bytes_per_second: Option<u64>,
    /// Half-open: connections are taken and kept, and nothing comes through.
    pub mute: bool,
    /// One bit is flipped per this number of bytes, on average.
    pub corrupt_every: Option<u64>,
    /// One byte is lost per this number of bytes, on average.
    pub drop_every: Option<u64>,
}

/// How open connections are ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cut {
    /// In order, as if both sides had closed them.
    Close,
    /// With RST: what is under way is lost.
    Reset,
    /// Not at all: both sides keep a connection on which nothing ever comes again.
    Strand,
}

#[derive(Debug, Default)]
struct Counters {
    connections: AtomicUsize,
    accepted: AtomicUsize,
    bytes: AtomicU64,
    flipped: AtomicU64,
    lost: AtomicU64,
}

/// What every connection sees.
#[derive(Debug, Clone)]
struct Wire {
    upstream: String,
    seed: u64,
    faults: watch::Receiver<Faults>,
    cuts: watch::Receiver<(u64, Cut)>,
    counters: Arc<Counters>,
}

/// A relay to one address; it and its connections end when it is dropped.
#[derive(Debug)]
pub struct Proxy {
    address: SocketAddr,
    faults: watch::Sender<Faults>,
    cuts: watch::Sender<(u64, Cut)>,
    counters: Arc<Counters>,
    stop: Option<watch::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Proxy {
    /// Relays a free port of loopback to `upstream` (`host:port`), which need not be there yet. What is random is drawn from
    /// `seed`, by connection and direction.
    pub fn start(upstream: &str, seed: u64) -> Self {
        let (faults, seen_faults) = watch::channel(Faults::default());
        let (cuts, seen_cuts) = watch::channel((0, Cut::Close));
        let (stop, mut stopped) = watch::channel(());
        let counters = Arc::new(Counters::default());
        let wire = Wire {
            upstream: upstream.to_owned(),
            seed,
            faults: seen_faults,
            cuts: seen_cuts,
            counters: counters.clone(),
        };
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        listener.set_nonblocking(true).expect("a socket that does not block");
        let address = listener.local_addr().expect("the socket's address");
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        let thread = std::thread::spawn(move || {
            runtime.block_on(async {
                let listener = TcpListener::from_std(listener).expect("the runtime takes the socket");
                tokio::select! {
                    () = accept(listener, wire) => {}
                    _ = stopped.changed() => {}
                }
            });
        });
        Self { address, faults, cuts, counters, stop: Some(stop), thread: Some(thread) }
    }

    /// Where it listens, `host:port`.
    pub fn address(&self) -> String {
        self.address.to_string()
    }

    /// From now on these faults, on open and new connections.
    pub fn set(&self, faults: Faults) {
        self.faults.send_replace(faults);
    }

    /// Ends all open connections in order.
    pub fn close(&self) {
        self.cut(Cut::Close);
    }

    /// Ends all open connections with RST.
    pub fn reset(&self) {
        self.cut(Cut::Reset);
    }

    /// Leaves all open connections open and mute for good, as a router does that forgot about them. New ones work.
    pub fn strand(&self) {
        self.cut(Cut::Strand);
    }

    fn cut(&self, cut: Cut) {
        self.cuts.send_modify(|(number, how)| (*number, *how) = (*number + 1, cut));
    }

    /// Open connections.
    pub fn connections(&self) -> usize {
        self.counters.connections.load(Ordering::SeqCst)
    }

    /// Connections so far.
    pub fn accepted(&self) -> usize {
        self.counters.accepted.load(Ordering::SeqCst)
    }

    /// Bytes that came through.
    pub fn bytes(&self) -> u64 {
        self.counters.bytes.load(Ordering::SeqCst)
    }

    /// Bits that were flipped.
    pub fn flipped(&self) -> u64 {
        self.counters.flipped.load(Ordering::SeqCst)
    }

    /// Bytes that were lost.
    pub fn lost(&self) -> u64 {
        self.counters.lost.load(Ordering::SeqCst)
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.stop = None;
        if let Some(thread) = self.thread.take() {
            // A panic in there has been printed.
            let _ = thread.join();
        }
    }
}

async fn accept(listener: TcpListener, wire: Wire) {
    for number in 0u32.. {
        let Ok((client, _)) = listener.accept().await else { return };
        wire.counters.accepted.fetch_add(1, Ordering::SeqCst);
        wire.counters.connections.fetch_add(1, Ordering::SeqCst);
        let wire = wire.clone();
        tokio::spawn(async move {
            connection(client, number, wire.clone()).await;
            wire.counters.connections.fetch_sub(1, Ordering::SeqCst);
        });
    }
}

async fn connection(mut client: TcpStream, number: u32, mut wire: Wire) {
    wire.cuts.mark_unchanged();
    let (mut cuts, mut faults) = (wire.cuts.clone(), wire.faults.clone());
    let mut server = None;
    let relayed = async {
        faults.wait_for(|faults| !faults.mute).await.map_err(io::Error::other)?;
        let server = server.insert(TcpStream::connect(&wire.upstream).await?);
        let _ = (client.set_nodelay(true), server.set_nodelay(true));
        let ((client_read, client_write), (server_read, server_write)) = (client.split(), server.split());
        let there = pump(client_read, server_write, wire.clone(), Damage::new(wire.seed, number, 0));
        let back = pump(server_read, client_write, wire.clone(), Damage::new(wire.seed, number, 1));
        tokio::try_join!(there, back)
    };
    let end = tokio::select! {
        end = relayed => end.map(|_| Cut::Close),
        _ = cuts.changed() => Ok(cuts.borrow().1),
    };
    if let Ok(Cut::Strand) = end {
        std::future::pending::<()>().await;
    }
    // What ended badly on one side ends badly on the other.
    if !matches!(end, Ok(Cut::Close)) {
        for socket in std::iter::once(&client).chain(&server) {
            let _ = socket.set_zero_linger();
        }
    }
}

/// Passes bytes on in one direction until that side has no more.
async fn pump(
    mut from: impl AsyncRead + Unpin,
    mut to: impl AsyncWrite + Unpin,
    wire: Wire,
    mut damage: Damage,
) -> io::Result<()> {
    let mut faults = wire.faults.clone();
    let mut buffer = vec![0; 16 << 10];
    loop {
        faults.wait_for(|faults| !faults.mute).await.map_err(io::Error::other)?;
        let count = tokio::select! {
            count = from.read(&mut buffer) => count?,
            // Perhaps it is mute now.
            changed = faults.changed() => match changed {
                Ok(()) => continue,
                Err(error) => return Err(io::Error::other(error)),
            },
        };
        if count == 0 {
            return to.shutdown().await;
        }
        let now = *faults.wait_for(|faults| !faults.mute).await.map_err(io::Error::other)?;
        tokio::time::sleep(now.delay).await;
        if let Some(rate) = now.bytes_per_second {
            tokio::time::sleep(Duration::from_secs_f64(count as f64 / rate.max(1) as f64)).await;
        }
        let bytes = damage.done_to(&buffer[..count], &now, &wire.counters);
        wire.counters.bytes.fetch_add(bytes.len() as u64, Ordering::SeqCst);
        to.write_all(&bytes).await?;
    }
}

/// Where bytes are flipped and lost in one direction of one connection.
#[derive(Debug)]
struct Damage {
    stream: Stream,
    until_flip: u64,
    until_loss: u64,
}

impl Damage {
    fn new(seed: u64, connection: u32, direction: u32) -> Self {
        let stream = Key::new(seed, Purpose::Request, &[connection, direction]).stream();
        Self { stream, until_flip: 0, until_loss: 0 }
    }

    fn done_to(&mut self, bytes: &[u8], faults: &Faults, counters: &Counters) -> Vec<u8> {
        let mut out = Vec::with_capacity(bytes.len());
        for &byte in bytes {
            if self.due(faults.drop_every, |damage| &mut damage.until_loss) {
                counters.lost.fetch_add(1, Ordering::SeqCst);
                continue;
            }
            let flip = self.due(faults.corrupt_every, |damage| &mut damage.until_flip);
            if flip {
                counters.flipped.fetch_add(1, Ordering::SeqCst);
            }
            out.push(if flip { byte ^ (1 << (self.stream.bits32() % 8)) } else { byte });
        }
        out
    }

    /// Counts down to the next event, which is drawn when there is none: uniform with the mean that was asked for.
    fn due(&mut self, every: Option<u64>, left: impl Fn(&mut Self) -> &mut u64) -> bool {
        let Some(mean) = every else { return false };
        if *left(self) == 0 {
            *left(self) = 1 + self.stream.bits64() % (2 * mean.max(1));
        }
        *left(self) -= 1;
        *left(self) == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{ErrorKind, Read as _, Write as _};
    use std::net::{Shutdown, TcpStream};
    use std::time::Instant;

    /// A server that says everything again, and a proxy in front of it.
    fn echo(seed: u64) -> Proxy {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        std::thread::spawn(move || {
            for socket in listener.incoming() {
                let mut socket = socket.unwrap();
                std::thread::spawn(move || {
                    let mut back = socket.try_clone().unwrap();
                    // A connection that is cut ends the copy.
                    let _ = std::io::copy(&mut socket, &mut back);
                    let _ = back.shutdown(Shutdown::Write);
                });
            }
        });
        Proxy::start(&address.to_string(), seed)
    }

    fn connect(proxy: &Proxy) -> TcpStream {
        let socket = TcpStream::connect(proxy.address()).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        socket
    }

    fn there_and_back(socket: &mut TcpStream, bytes: &[u8]) -> Vec<u8> {
        let mut writing = socket.try_clone().unwrap();
        let said = bytes.to_vec();
        let writer = std::thread::spawn(move || {
            writing.write_all(&said).unwrap();
            writing.shutdown(Shutdown::Write).unwrap();
        });
        let mut heard = Vec::new();
        socket.read_to_end(&mut heard).unwrap();
        writer.join().unwrap();
        heard
    }

    fn some_bytes(count: usize) -> Vec<u8> {
        (0..count).map(|i| (i * 7 + i / 251) as u8).collect()
    }

    #[test]
    fn without_faults_everything_comes_through() {
        let proxy = echo(1);
        let bytes = some_bytes(300_000);
        assert_eq!(there_and_back(&mut connect(&proxy), &bytes), bytes);
        assert_eq!((proxy.bytes(), proxy.flipped(), proxy.lost()), (600_000, 0, 0));
    }

    #[test]
    fn bits_flip_and_bytes_are_lost_in_the_same_places_with_the_same_seed() {
        let bytes = some_bytes(100_000);
        let heard = |seed: u64, faults: Faults| {
            let proxy = echo(seed);
            proxy.set(faults);
            (there_and_back(&mut connect(&proxy), &bytes), proxy.flipped(), proxy.lost())
        };
        let flipping = Faults { corrupt_every: Some(5_000), ..Faults::default() };
        let (flipped, count, _) = heard(3, flipping);
        assert_eq!(flipped.len(), bytes.len());
        let differing = flipped.iter().zip(&bytes).filter(|(a, b)| a != b).count() as u64;
        assert!(
            (20..=80).contains(&count) && differing.abs_diff(count) <= 2,
            "{count} flips, {differing} bytes differ"
        );
        assert_eq!(heard(3, flipping).0, flipped);
        assert_ne!(heard(4, flipping).0, flipped);
        let (short, _, lost) = heard(3, Faults { drop_every: Some(5_000), ..Faults::default() });
        assert!((20..=80).contains(&lost), "{lost}");
        assert_eq!(short.len() as u64, bytes.len() as u64 - lost);
    }

    #[test]
    fn delay_and_bandwidth_take_their_time() {
        let proxy = echo(1);
        let mut socket = connect(&proxy);
        proxy.set(Faults { delay: Duration::from_millis(150), ..Faults::default() });
        let start = Instant::now();
        assert_eq!(there_and_back(&mut socket, b"hello"), b"hello");
        assert!(start.elapsed() >= Duration::from_millis(300), "both ways: {:?}", start.elapsed());
        proxy.set(Faults { bytes_per_second: Some(200_000), ..Faults::default() });
        let (start, bytes) = (Instant::now(), some_bytes(60_000));
        assert_eq!(there_and_back(&mut connect(&proxy), &bytes), bytes);
        assert!(start.elapsed() >= Duration::from_millis(300), "{:?}", start.elapsed());
    }

    #[test]
    fn a_mute_connection_is_taken_and_says_nothing_until_it_may() {
        let proxy = echo(1);
        let mut before = connect(&proxy);
        before.write_all(b"a").unwrap();
        before.read_exact(&mut [0]).unwrap();
        proxy.set(Faults { mute: true, ..Faults::default() });
        let mut after = connect(&proxy);
        for socket in [&mut before, &mut after] {
            socket.write_all(b"b").unwrap();
            socket.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
            let silence = socket.read(&mut [0]).unwrap_err().kind();
            assert!(matches!(silence, ErrorKind::WouldBlock | ErrorKind::TimedOut), "{silence}");
            socket.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        }
        assert_eq!(proxy.connections(), 2, "nothing was closed");
        proxy.set(Faults::default());
        for socket in [&mut before, &mut after] {
            socket.read_exact(&mut [0]).unwrap();
        }
    }

    #[test]
    fn a_stranded_connection_stays_mute_and_new_ones_work() {
        let proxy = echo(1);
        let mut old = connect(&proxy);
        old.write_all(b"a").unwrap();
        old.read_exact(&mut [0]).unwrap();
        proxy.strand();
        old.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        old.write_all(b"b").unwrap();
        let silence = old.read(&mut [0]).unwrap_err().kind();
        assert!(matches!(silence, ErrorKind::WouldBlock | ErrorKind::TimedOut), "{silence}");
        assert_eq!(there_and_back(&mut connect(&proxy), b"new"), b"new");
        assert_eq!(proxy.accepted(), 2);
    }

    #[test]
    fn connections_are_closed_or_reset_and_new_ones_work() {
        let proxy = echo(1);
        for reset in [false, true] {
            let mut socket = connect(&proxy);
            socket.write_all(b"a").unwrap();
            socket.read_exact(&mut [0]).unwrap();
            if reset {
                proxy.reset()
            } else {
                proxy.close()
            }
            let end = socket.read(&mut [0]).map_err(|error| error.kind());
            assert_eq!(end, if reset { Err(ErrorKind::ConnectionReset) } else { Ok(0) });
        }
        assert_eq!(there_and_back(&mut connect(&proxy), b"again"), b"again");
        assert_eq!(proxy.accepted(), 3);
    }
}
