//! What is wrong at the other end of an address: a call has failed, and this finds out why, for a person. It asks the address
//! itself, because the errors of HTTP/2 and TLS stacks do not say what is there.

use crate::client::{Channel, Endpoint, Settings};
use crate::exit::Failure;
use crate::net::socket::Socket;
use crate::reload::span;
use crate::tls::ClientTls;
use crate::tls::validity::time_of_day;
use std::error::Error as _;
use std::io::{Error, ErrorKind};
use std::time::Duration;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::time::{Instant, timeout};
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_rustls::rustls::{self, AlertDescription as Alert, CertificateError};
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

/// A peer has this time for each step.
const PATIENCE: Duration = Duration::from_secs(2);
/// The beginning of an answer that is looked at, bytes.
const BEGINNING: usize = 512;
/// The same reason is told again after this time.
const REMIND: Duration = Duration::from_secs(60);
/// What an HTTP/2 client says first: the preface, and empty settings.
const HELLO: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";
/// What tonic says of an answer without a gRPC status.
const NO_GRPC: &str = "grpc-status header missing";

/// A gRPC service and its name for people.
pub type NamedService = (&'static str, &'static str);

/// Why a call failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Explanation {
    /// A sentence: what is there, and what to do.
    pub text: String,
    /// No call can succeed until a person changes something.
    pub permanent: bool,
}

impl Explanation {
    fn new(permanent: bool, text: impl Into<String>) -> Self {
        Self { text: text.into(), permanent }
    }
}

/// A service that a process calls.
#[derive(Debug, Clone)]
pub struct Remote {
    /// Its address.
    pub url: String,
    /// The credentials for it.
    pub settings: Settings,
    /// Its name for people.
    pub wanted: &'static str,
    /// The services that may be there in its place.
    pub known: &'static [NamedService],
}

impl Remote {
    /// A channel that connects with the first call.
    pub fn channel(&self) -> Result<Channel, Failure> {
        self.settings.lazy_channel(&self.url)
    }

    /// Why a call of this status has failed.
    pub async fn explain(&self, status: &Status) -> Explanation {
        explain(&self.settings, &self.url, self.wanted, self.known, status).await
    }
}

/// Explains the status of a failed call to `wanted` at `url`. `known` are the services that may be there in its place.
pub(crate) async fn explain(
    settings: &Settings,
    url: &str,
    wanted: &str,
    known: &[NamedService],
    status: &Status,
) -> Explanation {
    let said = || Explanation::new(false, words_of(status));
    let Ok(endpoint) = settings.reach(url) else { return said() };
    if let Some(code) = status.message().strip_prefix(NO_GRPC) {
        let code = code.rsplit(' ').next().unwrap_or_default();
        let gateway = ["502", "503", "504"].contains(&code);
        let text = if gateway {
            format!("a proxy answers at {url} with HTTP {code}: the service behind it is missing or not reachable")
        } else {
            format!(
                "what answers at {url} speaks HTTP/2 but not gRPC (HTTP {code}): a web server or a proxy; give the {wanted}'s address"
            )
        };
        return Explanation::new(!gateway, text);
    }
    if status.code() == Code::Unimplemented && status.message().is_empty() {
        return other_service(&endpoint, url, wanted, known).await;
    }
    // A status of the service itself has no source.
    if status.source().is_some() || matches!(status.code(), Code::Unknown | Code::Internal) {
        return probe(&endpoint, url, wanted).await.unwrap_or_else(said);
    }
    said()
}

/// Explains why no connection could be made, or what else is there; `None` if it looks like a gRPC service.
pub(crate) async fn probe(endpoint: &Endpoint, url: &str, wanted: &str) -> Option<Explanation> {
    let place = place(endpoint);
    let socket = match timeout(PATIENCE, endpoint.socket()).await {
        Ok(Ok(socket)) => socket,
        Ok(Err(error)) => return Some(Explanation::new(false, unreachable(&place, &error))),
        Err(_) => {
            return Some(Explanation::new(false, format!("{place} does not answer: check host, port and firewall")));
        }
    };
    match endpoint.tls() {
        Some((tls, name)) => probe_tls(socket, tls, name, url, wanted).await,
        None => {
            let begin = hello(&mut Socket::Plain(socket)).await;
            plain(endpoint, &begin, url, wanted).await
        }
    }
}

fn place(endpoint: &Endpoint) -> String {
    match endpoint.host.contains(':') {
        true => format!("[{}]:{}", endpoint.host, endpoint.port),
        false => format!("{}:{}", endpoint.host, endpoint.port),
    }
}

fn unreachable(place: &str, error: &Error) -> String {
    match error.kind() {
        ErrorKind::ConnectionRefused => format!("nothing listens at {place} (connection refused)"),
        _ if error.to_string().contains("lookup") => format!("the host name of {place} cannot be resolved: {error}"),
        _ => format!("{place} cannot be reached: {error}"),
    }
}

/// How a peer begins: its first bytes, or nothing within the time.
type Beginning = Result<Vec<u8>, Error>;

/// Greets in HTTP/2. The peer's first bytes; empty if it closes the connection.
async fn hello(socket: &mut Socket<TcpStream>) -> Beginning {
    let silent = |_| Error::from(ErrorKind::TimedOut);
    let greeting = async {
        socket.write_all(HELLO).await?;
        socket.flush().await?;
        let mut bytes = vec![0; BEGINNING];
        let count = socket.read(&mut bytes).await?;
        bytes.truncate(count);
        Ok(bytes)
    };
    timeout(PATIENCE, greeting).await.map_err(silent)?
}

/// A SETTINGS frame, with which every HTTP/2 server begins.
fn is_http2(begin: &[u8]) -> bool {
    begin.len() >= 9 && begin[3] == 4 && begin[5..9] == [0; 4]
}

fn is_tls(begin: &[u8]) -> bool {
    matches!(begin, [0x15 | 0x16, 3, ..])
}

async fn plain(endpoint: &Endpoint, begin: &Beginning, url: &str, wanted: &str) -> Option<Explanation> {
    let begin = match begin {
        Ok(begin) => begin.as_slice(),
        Err(error) if error.kind() == ErrorKind::TimedOut => {
            let text = format!("{} accepts connections and says nothing; it may not be a {wanted}", place(endpoint));
            return Some(Explanation::new(false, text));
        }
        Err(_) => &[],
    };
    if is_http2(begin) {
        return None;
    }
    let text = String::from_utf8_lossy(begin);
    // Servers with TLS answer with an alert, with a web page that says so, or not at all.
    if is_tls(begin) || text.contains("HTTPS") || (begin.is_empty() && answers_tls(endpoint).await) {
        let https = url.replacen("http://", "https://", 1);
        return Some(Explanation::new(
            true,
            format!("{} wants TLS; use {https}, with its CA in --tls-ca (MAGEX_TLS_CA)", place(endpoint)),
        ));
    }
    if begin.is_empty() {
        let text = format!("{} closes the connection without an answer; it may not be a {wanted}", place(endpoint));
        return Some(Explanation::new(false, text));
    }
    Some(Explanation::new(true, not_grpc(&place(endpoint), &text, wanted)))
}

/// What answers without gRPC, by its first line.
fn not_grpc(place: &str, begin: &str, wanted: &str) -> String {
    let line: String = begin.lines().next().unwrap_or_default().chars().filter(|c| !c.is_control()).take(40).collect();
    match line.starts_with("HTTP/1") {
        true => format!("a web server answers at {place} ({line}), not a {wanted}: check the port"),
        false => format!("what answers at {place} does not speak gRPC (it begins with '{line}'): check the port"),
    }
}

/// Whether a TLS server answers there. Nothing is sent to it but the first message of a handshake.
async fn answers_tls(endpoint: &Endpoint) -> bool {
    let config = rustls::ClientConfig::builder().with_root_certificates(rustls::RootCertStore::empty());
    let config = std::sync::Arc::new(config.with_no_client_auth());
    let Ok(name) = ServerName::try_from(endpoint.host.clone()) else { return false };
    let asking = async {
        let (mut first, mut begin) = (Vec::new(), [0; 2]);
        rustls::ClientConnection::new(config, name).ok()?.write_tls(&mut first).ok()?;
        let mut socket = endpoint.socket().await.ok()?;
        socket.write_all(&first).await.ok()?;
        socket.read_exact(&mut begin).await.ok()?;
        Some(is_tls(&begin))
    };
    timeout(PATIENCE, asking).await.ok().flatten().unwrap_or(false)
}

async fn probe_tls(
    socket: TcpStream,
    tls: &ClientTls,
    name: &ServerName<'static>,
    url: &str,
    wanted: &str,
) -> Option<Explanation> {
    let shaking = TlsConnector::from(tls.config()).connect(name.clone(), socket);
    let socket = match timeout(PATIENCE, shaking).await {
        Ok(Ok(socket)) => socket,
        Ok(Err(error)) => return Some(tls_problem(&error, tls, url, wanted)),
        Err(_) => return Some(Explanation::new(false, format!("{url} does not answer the TLS handshake"))),
    };
    let http2 = socket.get_ref().1.alpn_protocol().is_some();
    // A server of TLS 1.3 rejects the client's certificate only after the handshake.
    match hello(&mut Socket::Tls(Box::new(socket.into()))).await {
        Ok(begin) if http2 && is_http2(&begin) => None,
        Ok(begin) if !begin.is_empty() => {
            Some(Explanation::new(true, not_grpc(url, &String::from_utf8_lossy(&begin), wanted)))
        }
        Ok(_) | Err(_) if !http2 => {
            let text = format!("{url} speaks TLS but not HTTP/2, so it is not a {wanted}: check the port");
            Some(Explanation::new(true, text))
        }
        Ok(_) => Some(Explanation::new(false, format!("{url} closes the connection after the TLS handshake"))),
        Err(error) => Some(tls_problem(&error, tls, url, wanted)),
    }
}

fn tls_problem(error: &Error, tls: &ClientTls, url: &str, wanted: &str) -> Explanation {
    let Some(problem) = error.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>()) else {
        let closed =
            matches!(error.kind(), ErrorKind::UnexpectedEof | ErrorKind::ConnectionReset | ErrorKind::BrokenPipe);
        return match closed {
            true => Explanation::new(
                false,
                format!(
                    "{url} closes the connection during the TLS handshake: it may not use TLS (then use http://), or want a \
                     client certificate (--tls-cert and --tls-key)"
                ),
            ),
            false => Explanation::new(false, format!("{url}: {error}")),
        };
    };
    let ca = tls.ca().display();
    let text = match problem {
        rustls::Error::InvalidMessage(_) => {
            let http = url.replacen("https://", "http://", 1);
            format!("{url} answers without TLS: use {http}, or give the {wanted} a certificate; check the port, too")
        }
        rustls::Error::InvalidCertificate(problem) => return certificate_problem(problem, &ca.to_string(), url),
        rustls::Error::AlertReceived(alert) => match (alert, tls.own()) {
            (Alert::NoApplicationProtocol, _) => {
                format!("{url} speaks TLS but not HTTP/2, so it is not a {wanted}: check the port")
            }
            (Alert::CertificateRequired | Alert::HandshakeFailure | Alert::BadCertificate, None) => format!(
                "{url} wants a client certificate: give --tls-cert and --tls-key (MAGEX_TLS_CERT, MAGEX_TLS_KEY)"
            ),
            (Alert::UnknownCA, Some(own)) => {
                format!(
                    "{url} does not trust the CA of the client certificate {}: use one of its --client-ca",
                    own.display()
                )
            }
            (Alert::CertificateExpired, Some(own)) => {
                format!("{url} refuses the client certificate {}, which has ended: renew it", own.display())
            }
            (alert, Some(own)) => format!("{url} refuses the client certificate {} ({alert:?})", own.display()),
            (alert, None) => format!("{url} ends the TLS handshake ({alert:?})"),
        },
        other => format!("{url}: the TLS handshake failed: {other}"),
    };
    Explanation::new(true, text)
}

fn certificate_problem(problem: &CertificateError, ca: &str, url: &str) -> Explanation {
    let now = time_of_day();
    let text = match problem {
        CertificateError::UnknownIssuer | CertificateError::BadSignature => {
            format!("the certificate of {url} is not of the CA in {ca}: give the right CA with --tls-ca (MAGEX_TLS_CA)")
        }
        CertificateError::NotValidForNameContext { presented, .. } => {
            format!("the certificate of {url} is for {}: use that name, or issue another", presented.join(", "))
        }
        CertificateError::NotValidForName => format!("the certificate of {url} is for another name"),
        CertificateError::ExpiredContext { not_after, .. } => {
            let ended = Duration::from_secs(not_after.as_secs());
            format!("the certificate of {url} ended {} ago: renew it there", span(now.saturating_sub(ended)))
        }
        CertificateError::NotValidYetContext { not_before, .. } => {
            let begins = Duration::from_secs(not_before.as_secs());
            let wait = span(begins.saturating_sub(now));
            format!("the certificate of {url} begins in {wait} by this machine's clock: check the clock")
        }
        // What `openssl req -x509` makes unless it is told otherwise.
        other if other.to_string().contains("CaUsedAsEndEntity") => format!(
            "the certificate of {url} is one of an authority (CA:TRUE): give the service one that such an authority has signed"
        ),
        other => format!("the certificate of {url} is not accepted: {other}"),
    };
    Explanation::new(true, text)
}

/// UNIMPLEMENTED without a text: there is no such service. The health service says which one there is.
async fn other_service(endpoint: &Endpoint, url: &str, wanted: &str, known: &[NamedService]) -> Explanation {
    let mut health = HealthClient::new(endpoint.connect_lazy());
    for (service, name) in known.iter().filter(|(_, name)| *name != wanted) {
        let check = health.check(HealthCheckRequest { service: (*service).to_owned() });
        if matches!(timeout(PATIENCE, check).await, Ok(Ok(_))) {
            return Explanation::new(
                true,
                format!("a {name} answers at {url}, not a {wanted}: give the {wanted}'s address"),
            );
        }
    }
    Explanation::new(true, format!("a gRPC service answers at {url}, but not a {wanted}: give the {wanted}'s address"))
}

/// The text of a status; if there is none, its code.
fn words_of(status: &Status) -> String {
    let root = status.source().map(crate::client::root_of);
    let text = if status.message().is_empty() { root.unwrap_or_default() } else { status.message().to_owned() };
    if text.is_empty() { status.code().description().to_owned() } else { text }
}

/// What a client that tries again says, and how often: that something must be changed each time, otherwise the reason when it
/// changes, and once a minute.
#[derive(Debug, Default)]
pub struct Complaints {
    last: Option<(String, Instant)>,
}

impl Complaints {
    /// Whether to say this now.
    pub fn due(&mut self, explanation: &Explanation) -> bool {
        let due = match &self.last {
            Some((text, at)) => explanation.permanent || *text != explanation.text || at.elapsed() >= REMIND,
            None => true,
        };
        if due {
            self.last = Some((explanation.text.clone(), Instant::now()));
        }
        due
    }

    /// The peer answers. Whether there was something to complain of.
    pub fn over(&mut self) -> bool {
        self.last.take().is_some()
    }
}

#[cfg(test)]
mod tests;
