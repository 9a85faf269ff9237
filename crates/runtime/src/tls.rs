//! Certificates of servers and clients (rustls). They are checked when they are read, and can be read again while they are in
//! use: connections that are open keep what they began with.

pub(crate) mod pem;
pub(crate) mod validity;

use crate::exit::Failure;
use crate::sync::Live;
use pem::NamedFile;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio_rustls::rustls;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{ClientConfig, RootCertStore, ServerConfig};

/// gRPC is HTTP/2.
const ALPN: &[u8] = b"h2";

/// The end of the validity of a certificate in a file, since 1970.
pub(crate) type End = (PathBuf, Duration);

/// A certificate chain and its key.
#[derive(Debug, Clone)]
struct Pair {
    certificate: NamedFile,
    key: NamedFile,
}

impl Pair {
    fn new(certificate: &Path, key: &Path) -> Self {
        Self { certificate: NamedFile::new("--tls-cert", certificate), key: NamedFile::new("--tls-key", key) }
    }

    /// The chain, the key, and the end of the chain's first certificate.
    fn read(&self) -> Result<(Vec<CertificateDer<'static>>, PrivateKeyDer<'static>, Vec<End>), Failure> {
        let (chain, key) = (self.certificate.certificates()?, self.key.key()?);
        let end = chain.first().and_then(validity::end).map(|end| (self.certificate.path.clone(), end));
        Ok((chain, key, end.into_iter().collect()))
    }

    fn wrong(&self, error: &rustls::Error) -> Failure {
        let certificate = self.certificate.path.display();
        match error {
            rustls::Error::InconsistentKeys(_) => self.key.wrong(format!(
                "this key does not belong to the first certificate in {certificate}; give the key with which that \
                 certificate was made"
            )),
            rustls::Error::InvalidCertificate(error) => self.certificate.wrong(format!("damaged certificate: {error}")),
            error => self.key.wrong(format!(
                "this key cannot be used ({error}); use RSA of 2048 bits or more, ECDSA on P-256 or P-384, or Ed25519"
            )),
        }
    }

    fn files(&self) -> [PathBuf; 2] {
        [self.certificate.path.clone(), self.key.path.clone()]
    }
}

/// The certificates in a file, as those that are trusted, and their ends.
fn roots(file: &NamedFile) -> Result<(RootCertStore, Vec<End>), Failure> {
    let (mut roots, certificates) = (RootCertStore::empty(), file.certificates()?);
    let ends = certificates.iter().filter_map(validity::end).map(|end| (file.path.clone(), end)).collect();
    for certificate in certificates {
        roots.add(certificate).map_err(|error| file.wrong(format!("no certificate of an authority: {error}")))?;
    }
    Ok((roots, ends))
}

/// A server's certificate and the CA of its clients.
#[derive(Debug, Clone)]
pub struct ServerTls {
    pair: Pair,
    client_ca: Option<NamedFile>,
    live: Live<(Arc<ServerConfig>, Vec<End>)>,
}

impl ServerTls {
    /// Reads the server's certificate chain and key; with `client_ca`, every client must present a certificate of that CA.
    pub fn read(certificate: &Path, key: &Path, client_ca: Option<&Path>) -> Result<Self, Failure> {
        let pair = Pair::new(certificate, key);
        let client_ca = client_ca.map(|path| NamedFile::new("--client-ca", path));
        let live = Live::new(Self::load(&pair, client_ca.as_ref())?);
        Ok(Self { pair, client_ca, live })
    }

    fn load(pair: &Pair, client_ca: Option<&NamedFile>) -> Result<(Arc<ServerConfig>, Vec<End>), Failure> {
        let (chain, key, mut ends) = pair.read()?;
        let builder = match client_ca {
            None => ServerConfig::builder().with_no_client_auth(),
            Some(file) => {
                let (roots, trusted) = roots(file)?;
                ends.extend(trusted);
                let verifier = WebPkiClientVerifier::builder(roots.into()).build();
                ServerConfig::builder().with_client_cert_verifier(verifier.map_err(|error| file.wrong(error))?)
            }
        };
        let mut config = builder.with_single_cert(chain, key).map_err(|error| pair.wrong(&error))?;
        config.alpn_protocols.push(ALPN.into());
        Ok((Arc::new(config), ends))
    }

    /// Reads the files again. If they cannot be used, nothing changes.
    pub fn reload(&self) -> Result<(), Failure> {
        self.live.set(Self::load(&self.pair, self.client_ca.as_ref())?);
        Ok(())
    }

    pub(crate) fn config(&self) -> Arc<ServerConfig> {
        self.live.get().0.clone()
    }

    /// Clients must present a certificate.
    pub(crate) fn mutual(&self) -> bool {
        self.client_ca.is_some()
    }

    pub(crate) fn files(&self) -> Vec<PathBuf> {
        self.pair.files().into_iter().chain(self.client_ca.iter().map(|file| file.path.clone())).collect()
    }

    pub(crate) fn ends(&self) -> Vec<End> {
        self.live.get().1.clone()
    }
}

/// The CA that a client trusts, and its own certificate.
#[derive(Debug, Clone)]
pub struct ClientTls {
    ca: NamedFile,
    pair: Option<Pair>,
    live: Live<(Arc<ClientConfig>, Vec<End>)>,
}

impl ClientTls {
    /// Reads the CA of the server's certificate, and the client's certificate and key.
    pub fn read(ca: &Path, certificate: Option<&Path>, key: Option<&Path>) -> Result<Self, Failure> {
        let ca = NamedFile::new("--tls-ca", ca);
        let pair = match (certificate, key) {
            (Some(certificate), Some(key)) => Some(Pair::new(certificate, key)),
            (None, None) => None,
            _ => return Err(Failure::usage("the client's certificate and its key belong together: give both or none")),
        };
        let live = Live::new(Self::load(&ca, pair.as_ref())?);
        Ok(Self { ca, pair, live })
    }

    fn load(ca: &NamedFile, pair: Option<&Pair>) -> Result<(Arc<ClientConfig>, Vec<End>), Failure> {
        let (roots, mut ends) = roots(ca)?;
        let builder = ClientConfig::builder().with_root_certificates(roots);
        let mut config = match pair {
            None => builder.with_no_client_auth(),
            Some(pair) => {
                let (chain, key, own) = pair.read()?;
                ends.extend(own);
                builder.with_client_auth_cert(chain, key).map_err(|error| pair.wrong(&error))?
            }
        };
        config.alpn_protocols.push(ALPN.into());
        Ok((Arc::new(config), ends))
    }

    /// Reads the files that `MAGEX_TLS_CA`, and optionally `MAGEX_TLS_CERT` and `MAGEX_TLS_KEY`, name.
    pub fn from_env() -> Result<Self, Failure> {
        let path = |name: &str| std::env::var_os(name).filter(|path| !path.is_empty()).map(PathBuf::from);
        let ca = path("MAGEX_TLS_CA").ok_or_else(|| {
            Failure::usage("set MAGEX_TLS_CA to the file of the CA of the service's certificate, or use http://")
        })?;
        Self::read(&ca, path("MAGEX_TLS_CERT").as_deref(), path("MAGEX_TLS_KEY").as_deref())
    }

    /// Reads the files again. If they cannot be used, nothing changes.
    pub fn reload(&self) -> Result<(), Failure> {
        self.live.set(Self::load(&self.ca, self.pair.as_ref())?);
        Ok(())
    }

    pub(crate) fn config(&self) -> Arc<ClientConfig> {
        self.live.get().0.clone()
    }

    /// The client presents a certificate: its file.
    pub(crate) fn own(&self) -> Option<&Path> {
        self.pair.as_ref().map(|pair| pair.certificate.path.as_path())
    }

    pub(crate) fn ca(&self) -> &Path {
        &self.ca.path
    }

    pub(crate) fn files(&self) -> Vec<PathBuf> {
        let own = self.pair.iter().flat_map(Pair::files);
        std::iter::once(self.ca.path.clone()).chain(own).collect()
    }

    pub(crate) fn ends(&self) -> Vec<End> {
        self.live.get().1.clone()
    }
}

#[cfg(test)]
pub(crate) mod tests;
