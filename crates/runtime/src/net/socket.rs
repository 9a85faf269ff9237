//! The sockets of servers and clients: plain, or encrypted after a handshake.

use crate::net::auth::{Peer, sha256_hex};
use crate::net::connections::{Connection, Incoming};
use crate::tls::ServerTls;
use std::io::{Error, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::task::JoinSet;
use tokio_rustls::{TlsAcceptor, TlsStream};
use tokio_stream::Stream;
use tonic::transport::server::Connected;

/// A socket with or without TLS.
#[derive(Debug)]
pub enum Socket<T> {
    /// As it comes.
    Plain(T),
    /// After the handshake.
    Tls(Box<TlsStream<T>>),
}

macro_rules! forward {
    ($self:ident, $socket:ident => $call:expr) => {
        match $self.get_mut() {
            Socket::Plain($socket) => {
                let $socket = Pin::new($socket);
                $call
            }
            Socket::Tls($socket) => {
                let $socket = Pin::new(&mut **$socket);
                $call
            }
        }
    };
}

impl<T: AsyncRead + AsyncWrite + Unpin> AsyncRead for Socket<T> {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<Result<(), Error>> {
        forward!(self, socket => socket.poll_read(cx, buf))
    }
}

impl<T: AsyncRead + AsyncWrite + Unpin> AsyncWrite for Socket<T> {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<Result<usize, Error>> {
        forward!(self, socket => socket.poll_write(cx, bytes))
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<Result<usize, Error>> {
        forward!(self, socket => socket.poll_write_vectored(cx, slices))
    }

    fn is_write_vectored(&self) -> bool {
        match self {
            Self::Plain(socket) => socket.is_write_vectored(),
            Self::Tls(socket) => socket.is_write_vectored(),
        }
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Result<(), Error>> {
        forward!(self, socket => socket.poll_flush(cx))
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Result<(), Error>> {
        forward!(self, socket => socket.poll_shutdown(cx))
    }
}

impl Connected for Connection {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        Peer { address: self.address(), certificate: None }
    }
}

impl Connected for Socket<Connection> {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        match self {
            Self::Plain(connection) => connection.connect_info(),
            Self::Tls(socket) => {
                let (connection, session) = socket.get_ref();
                let leaf = session.peer_certificates().and_then(|chain| chain.first());
                Peer { certificate: leaf.map(|leaf| sha256_hex(leaf).into()), ..connection.connect_info() }
            }
        }
    }
}

/// The connections of a listener, after their handshakes. The certificate of a handshake is the one in force when it begins.
#[derive(Debug)]
pub(crate) struct Sockets {
    incoming: Incoming,
    tls: Option<ServerTls>,
    handshakes: JoinSet<Option<Socket<Connection>>>,
}

impl Sockets {
    pub(crate) fn new(incoming: Incoming, tls: Option<ServerTls>) -> Self {
        Self { incoming, tls, handshakes: JoinSet::new() }
    }
}

/// A connection that is slow with this is closed by its table ([`crate::net::connections::ConnectionLimits::first_call`]).
async fn shake_hands(connection: Connection, tls: ServerTls) -> Option<Socket<Connection>> {
    let peer = connection.address();
    match TlsAcceptor::from(tls.config()).accept(connection).await {
        Ok(socket) => Some(Socket::Tls(Box::new(socket.into()))),
        Err(error) => {
            tracing::debug!(%peer, %error, "TLS handshake failed");
            None
        }
    }
}

impl Stream for Sockets {
    type Item = Result<Socket<Connection>, Error>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        loop {
            match self.handshakes.poll_join_next(cx) {
                Poll::Ready(Some(Ok(Some(socket)))) => return Poll::Ready(Some(Ok(socket))),
                // It failed; look for the next.
                Poll::Ready(Some(_)) => continue,
                Poll::Ready(None) | Poll::Pending => {}
            }
            let next = std::task::ready!(Pin::new(&mut self.incoming).poll_next(cx));
            match (next, self.tls.clone()) {
                (Some(Ok(connection)), Some(tls)) => drop(self.handshakes.spawn(shake_hands(connection, tls))),
                (Some(Ok(connection)), None) => return Poll::Ready(Some(Ok(Socket::Plain(connection)))),
                (Some(Err(error)), _) => return Poll::Ready(Some(Err(error))),
                (None, _) => return Poll::Ready(None),
            }
        }
    }
}
