//! Clients of services: channels with TLS and credentials.

use crate::Boxed;
use crate::exit::{self, Failure};
use crate::net::socket::Socket;
use crate::reload::Source;
use crate::sync::Live;
use crate::tls::ClientTls;
use hyper_util::rt::TokioIo;
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::net::{TcpStream, UnixStream};
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::ServerName;
use tonic::codegen::Service;
use tonic::codegen::http::Uri;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport;
use tonic::{Request, Status};

/// A channel whose calls carry the client's token, if it has one.
pub type Channel = InterceptedService<transport::Channel, Bearer>;

/// A bearer token; clones share it. It is marked as sensitive, so that debug output does not show it.
#[derive(Debug, Clone)]
pub struct Token {
    path: Option<PathBuf>,
    live: Live<MetadataValue<Ascii>>,
}

impl Token {
    /// A token, without surrounding whitespace; `source` names its origin in errors. An error does not contain it.
    pub fn new(text: &str, source: &str) -> Result<Self, Failure> {
        Ok(Self { path: None, live: Live::new(Self::parse(text, source)?) })
    }

    fn parse(text: &str, source: &str) -> Result<MetadataValue<Ascii>, Failure> {
        let wrong = || Failure::usage(format!("{source}: a token is one line of printable ASCII"));
        let text = text.trim();
        if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err(wrong());
        }
        let mut value: MetadataValue<Ascii> = format!("Bearer {text}").parse().map_err(|_| wrong())?;
        value.set_sensitive(true);
        Ok(value)
    }

    fn load(path: &Path) -> Result<MetadataValue<Ascii>, Failure> {
        let text = crate::options::text_file("--token-file", path)?;
        Self::parse(&text, &format!("--token-file {}", path.display()))
    }

    /// Reads a token from a file.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        Ok(Self { path: Some(path.to_owned()), live: Live::new(Self::load(path)?) })
    }

    /// Reads its file again, if it has one. If that cannot be used, nothing changes.
    fn reload(&self) -> Result<(), Failure> {
        if let Some(path) = &self.path {
            self.live.set(Self::load(path)?);
        }
        Ok(())
    }
}

/// The credentials of a client and the CA that it trusts, for all its connections.
#[derive(Debug, Clone, Default)]
pub struct Settings {
    /// For https.
    pub tls: Option<ClientTls>,
    /// Sent with every call.
    pub token: Option<Token>,
    /// The token may be sent without TLS.
    pub insecure: bool,
}

impl Settings {
    /// A channel that connects with the first call and reconnects after failures. Fails if the token would be sent without TLS.
    pub fn lazy_channel(&self, url: &str) -> Result<Channel, Failure> {
        let (endpoint, bearer) = self.endpoint(url)?;
        Ok(InterceptedService::new(endpoint.connect_lazy(), bearer))
    }

    /// Where `url` leads, whatever the token.
    pub(crate) fn reach(&self, url: &str) -> Result<Endpoint, Failure> {
        endpoint_with(url, self.tls.as_ref())
    }

    /// A connected channel. Wrong usage has the exit code of [`Failure::usage`], a failed connection [`exit::UNAVAILABLE`].
    pub fn connect<'a>(&'a self, url: &'a str) -> Boxed<'a, Result<Channel, Failure>> {
        Box::pin(async move {
            let (endpoint, bearer) = self.endpoint(url)?;
            let channel = endpoint.connect().await.map_err(|error| Failure::new(exit::UNAVAILABLE, root_of(&error)))?;
            Ok(InterceptedService::new(channel, bearer))
        })
    }

    /// What can be read again while connections are open; new connections and calls use it.
    pub fn sources(&self) -> Vec<Source> {
        let tls = self.tls.clone().map(|tls| {
            let (files, again, ends) = (tls.files(), tls.clone(), tls);
            Source::new("the certificates for calls", files, move || again.reload()).ending(move || ends.ends())
        });
        let token = self.token.clone().and_then(|token| {
            let files = vec![token.path.clone()?];
            Some(Source::new("the token", files, move || token.reload()))
        });
        tls.into_iter().chain(token).collect()
    }

    /// Whether calls could be made to the address that an option gave; nothing is connected.
    ///
    /// # Errors
    /// Wrong usage; the error names the option.
    pub fn check(&self, option: &str, url: &str) -> Result<(), Failure> {
        let checked = self.endpoint(url);
        checked.map(drop).map_err(|error| Failure::new(error.code, format!("{option}: {error}")))
    }

    fn endpoint(&self, url: &str) -> Result<(Endpoint, Bearer), Failure> {
        let endpoint = endpoint_with(url, self.tls.as_ref())?;
        let encrypted = endpoint.tls.is_some();
        if self.token.is_some() && !encrypted && !self.insecure && !is_local(Some(&endpoint.host)) {
            return Err(Failure::usage(format!(
                "'{url}': the token would be sent unencrypted to another machine; use https, or --insecure to allow it"
            )));
        }
        Ok((endpoint, Bearer(self.token.clone())))
    }
}

/// The innermost error: the outer ones of a transport carry no detail.
pub fn root_of(error: &dyn std::error::Error) -> String {
    let mut root = error;
    while let Some(source) = root.source() {
        root = source;
    }
    root.to_string()
}

/// Whether a host is this machine: a loopback address, or `localhost`.
fn is_local(host: Option<&str>) -> bool {
    let host = host.unwrap_or_default().trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || host.parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback())
}

/// Adds the token to every call.
#[derive(Debug, Clone)]
pub struct Bearer(Option<Token>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.0 {
            request.metadata_mut().insert("authorization", (*token.live.get()).clone());
        }
        Ok(request)
    }
}

/// Where a channel connects to. Its certificates are those that are in force when a connection is made.
#[derive(Debug, Clone)]
pub struct Endpoint {
    endpoint: transport::Endpoint,
    pub(crate) host: String,
    pub(crate) port: u16,
    tls: Option<(ClientTls, ServerName<'static>)>,
}

impl Endpoint {
    /// A channel that connects with the first call and reconnects after failures.
    pub fn connect_lazy(&self) -> transport::Channel {
        self.endpoint.connect_with_connector_lazy(self.clone())
    }

    /// A connected channel.
    pub async fn connect(&self) -> Result<transport::Channel, transport::Error> {
        self.endpoint.connect_with_connector(self.clone()).await
    }

    /// A socket at that address, before TLS.
    pub(crate) async fn socket(&self) -> Result<TcpStream, Error> {
        let socket = TcpStream::connect((self.host.as_str(), self.port)).await?;
        socket.set_nodelay(true)?;
        Ok(socket)
    }

    /// The certificates with which it connects, and the name that the peer must have.
    pub(crate) fn tls(&self) -> Option<&(ClientTls, ServerName<'static>)> {
        self.tls.as_ref()
    }

    async fn open(self) -> Result<TokioIo<Socket<TcpStream>>, Error> {
        let socket = self.socket().await?;
        let Some((tls, name)) = self.tls else { return Ok(TokioIo::new(Socket::Plain(socket))) };
        let socket = TlsConnector::from(tls.config()).connect(name, socket).await?;
        if socket.get_ref().1.alpn_protocol().is_none() {
            return Err(Error::new(ErrorKind::InvalidData, "the service does not speak HTTP/2"));
        }
        Ok(TokioIo::new(Socket::Tls(Box::new(socket.into()))))
    }
}

/// Connects; the address is the endpoint's own.
impl Service<Uri> for Endpoint {
    type Response = TokioIo<Socket<TcpStream>>;
    type Error = Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, Error>> + Send>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Error>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, _: Uri) -> Self::Future {
        Box::pin(self.clone().open())
    }
}

/// A socket in the file system of this machine.
#[derive(Debug, Clone)]
struct Local(PathBuf);

impl Service<Uri> for Local {
    type Response = TokioIo<UnixStream>;
    type Error = Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, Error>> + Send>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Error>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, _: Uri) -> Self::Future {
        let path = self.0.clone();
        Box::pin(async move { UnixStream::connect(path).await.map(TokioIo::new) })
    }
}

/// A connected channel to a Unix socket, without credentials: the file system says which processes may use it.
pub async fn connect_local(path: &Path) -> Result<Channel, transport::Error> {
    let endpoint = transport::Endpoint::from_static("http://localhost");
    let channel = endpoint.connect_with_connector(Local(path.to_owned())).await?;
    Ok(InterceptedService::new(channel, Bearer(None)))
}

/// An endpoint with our settings, without certificates.
pub fn endpoint(url: &str) -> Result<Endpoint, Failure> {
    endpoint_with(url, None)
}

/// An endpoint that takes the certificates for an https URL from the environment.
pub fn endpoint_from_env(url: &str) -> Result<Endpoint, Failure> {
    let secure = url.trim_start().to_ascii_lowercase().starts_with("https:");
    let tls = secure.then(ClientTls::from_env).transpose()?;
    endpoint_with(url, tls.as_ref())
}

/// An endpoint that detects a dead peer within 15 s, even on an idle connection. Certificates apply to https only.
pub fn endpoint_with(url: &str, tls: Option<&ClientTls>) -> Result<Endpoint, Failure> {
    let wrong = |reason: String| {
        let form = "use the form http://host:port, or https://host:port";
        Failure::usage(format!("'{url}' is not an address to connect to ({reason}): {form}"))
    };
    let origin: Uri = url.parse().map_err(|error| wrong(format!("{error}")))?;
    let (Some(host), Some(authority)) = (origin.host(), origin.authority()) else {
        return Err(wrong("no host".to_owned()));
    };
    let host = host.trim_start_matches('[').trim_end_matches(']').to_owned();
    let (port, tls) = match (origin.scheme_str(), tls) {
        (Some("http"), _) => (80, None),
        (Some("https"), Some(tls)) => {
            let name = ServerName::try_from(host.clone()).map_err(|error| wrong(error.to_string()))?;
            (443, Some((tls.clone(), name)))
        }
        (Some("https"), None) => {
            let problem = "name the CA of its certificate: MAGEX_TLS_CA or --tls-ca";
            return Err(wrong(problem.to_owned()));
        }
        _ => return Err(wrong("not an http url".to_owned())),
    };
    let port = origin.port_u16().unwrap_or(port);
    // tonic would insist on its own TLS for an https address; what a call names as its origin is another matter.
    let endpoint = transport::Endpoint::from_shared(format!("http://{authority}"))
        .map_err(|error| wrong(error.to_string()))?
        .origin(origin)
        .connect_timeout(Duration::from_secs(3))
        .http2_keep_alive_interval(Duration::from_secs(10))
        .keep_alive_timeout(Duration::from_secs(5))
        .keep_alive_while_idle(true)
        .initial_stream_window_size(8 << 20)
        .initial_connection_window_size(16 << 20);
    Ok(Endpoint { endpoint, host, port, tls })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_malformed_url_is_rejected_with_the_expected_form() {
        for url in ["", "localhost:7000", "127.0.0.1:7000", "ftp://x:1", "http://", "https://x:1"] {
            let error = endpoint(url).unwrap_err().to_string();
            assert!(error.contains("http://host:port"), "{error}");
        }
        endpoint("http://localhost:7000").unwrap();
    }

    #[test]
    fn a_token_is_sent_only_over_tls_or_to_this_machine() {
        let settings = Settings { token: Some(Token::new(" s3cret\n", "here").unwrap()), ..Settings::default() };
        for url in ["http://localhost:1", "http://127.0.0.1:1", "http://127.9.9.9:1", "http://[::1]:1"] {
            settings.endpoint(url).unwrap();
        }
        for url in ["http://10.0.0.1:1", "http://learner:1", "http://localhost.evil:1", "http://[2001:db8::1]:1"] {
            let error = settings.endpoint(url).unwrap_err();
            assert!(error.message.contains("sent unencrypted"), "{error}");
            Settings { insecure: true, ..settings.clone() }.endpoint(url).unwrap();
            Settings::default().endpoint(url).unwrap();
        }
    }

    #[test]
    fn a_token_is_sent_but_never_logged() {
        let token = Token::new(" s3cret\n", "here").unwrap();
        let request = Bearer(Some(token.clone())).call(Request::new(())).unwrap();
        assert_eq!(request.metadata().get("authorization").unwrap(), "Bearer s3cret");
        assert!(!format!("{request:?}{token:?}").contains("s3cret"));
        for text in ["", " \n", "two words", "two\nlines", "ümlaut"] {
            assert!(Token::new(text, "MAGEX_TOKEN").unwrap_err().to_string().starts_with("MAGEX_TOKEN: "));
        }
    }
}
