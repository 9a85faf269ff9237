//! Certificates of servers and clients (rustls), read from PEM files.

use std::path::{Path, PathBuf};
use tonic::transport::{Certificate, ClientTlsConfig, Identity, ServerTlsConfig};

/// Why certificates are unusable.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read.
    #[error("{path}: {source}")]
    File {
        /// Its name.
        path: String,
        /// The error of the system.
        source: std::io::Error,
    },
    /// A certificate without its key, or a key without its certificate.
    #[error("{0} and {1} belong together: give both or none")]
    Half(&'static str, &'static str),
    /// The content of the files.
    #[error("the certificates are unusable: {0}")]
    Unusable(String),
}

/// A server's certificate and the CA of its clients.
#[derive(Clone)]
pub struct ServerTls {
    certificate: Vec<u8>,
    key: Vec<u8>,
    client_ca: Option<Vec<u8>>,
}

// A key must not reach a log.
impl std::fmt::Debug for ServerTls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ServerTls").field("mutual", &self.mutual()).finish_non_exhaustive()
    }
}

impl ServerTls {
    /// Reads the server's certificate chain and key; with `client_ca`, every client must present a certificate of that CA.
    ///
    /// # Errors
    /// A file cannot be read.
    pub fn read(certificate: &Path, key: &Path, client_ca: Option<&Path>) -> Result<Self, TlsError> {
        Ok(Self { certificate: read(certificate)?, key: read(key)?, client_ca: client_ca.map(read).transpose()? })
    }

    /// Clients must present a certificate.
    pub fn mutual(&self) -> bool {
        self.client_ca.is_some()
    }

    pub(crate) fn config(&self) -> ServerTlsConfig {
        let config = ServerTlsConfig::new().identity(Identity::from_pem(&self.certificate, &self.key));
        match &self.client_ca {
            Some(ca) => config.client_ca_root(Certificate::from_pem(ca)),
            None => config,
        }
    }
}

/// The CA that a client trusts, and its own certificate.
#[derive(Clone, PartialEq, Eq)]
pub struct ClientTls {
    ca: Vec<u8>,
    identity: Option<(Vec<u8>, Vec<u8>)>,
}

impl std::fmt::Debug for ClientTls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ClientTls").field("identity", &self.identity.is_some()).finish_non_exhaustive()
    }
}

impl ClientTls {
    /// Reads the CA of the server's certificate, and the client's certificate and key.
    ///
    /// # Errors
    /// A file cannot be read, or a certificate has no key.
    pub fn read(ca: &Path, certificate: Option<&Path>, key: Option<&Path>) -> Result<Self, TlsError> {
        let identity = match (certificate, key) {
            (Some(certificate), Some(key)) => Some((read(certificate)?, read(key)?)),
            (None, None) => None,
            _ => return Err(TlsError::Half("the client's certificate", "its key")),
        };
        Ok(Self { ca: read(ca)?, identity })
    }

    /// Reads the files that `MAGEX_TLS_CA`, and optionally `MAGEX_TLS_CERT` and `MAGEX_TLS_KEY`, name.
    ///
    /// # Errors
    /// `MAGEX_TLS_CA` is not set, and as [`ClientTls::read`].
    pub fn from_env() -> Result<Self, TlsError> {
        let path = |name: &str| std::env::var_os(name).map(PathBuf::from);
        let ca = path("MAGEX_TLS_CA").ok_or_else(|| {
            let problem = "set MAGEX_TLS_CA to the file of the CA of the service's certificate";
            TlsError::Unusable(problem.to_owned())
        })?;
        Self::read(&ca, path("MAGEX_TLS_CERT").as_deref(), path("MAGEX_TLS_KEY").as_deref())
    }

    pub(crate) fn config(&self) -> ClientTlsConfig {
        let config = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(&self.ca));
        match &self.identity {
            Some((certificate, key)) => config.identity(Identity::from_pem(certificate, key)),
            None => config,
        }
    }
}

fn read(path: &Path) -> Result<Vec<u8>, TlsError> {
    std::fs::read(path).map_err(|source| TlsError::File { path: path.display().to_string(), source })
}
