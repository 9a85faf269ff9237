//! Certificates of servers and clients (rustls), read from PEM files.

use crate::exit::Failure;
use std::path::{Path, PathBuf};
use tonic::transport::{Certificate, ClientTlsConfig, Identity, ServerTlsConfig};

/// A server's certificate and the CA of its clients.
#[derive(Debug, Clone)]
pub struct ServerTls {
    pub(crate) config: ServerTlsConfig,
    /// Clients must present a certificate.
    pub(crate) mutual: bool,
}

impl ServerTls {
    /// Reads the server's certificate chain and key; with `client_ca`, every client must present a certificate of that CA.
    pub fn read(certificate: &Path, key: &Path, client_ca: Option<&Path>) -> Result<Self, Failure> {
        let config = ServerTlsConfig::new()
            .identity(Identity::from_pem(read("--tls-cert", certificate)?, read("--tls-key", key)?));
        let config = match client_ca {
            Some(ca) => config.client_ca_root(Certificate::from_pem(read("--client-ca", ca)?)),
            None => config,
        };
        Ok(Self { config, mutual: client_ca.is_some() })
    }
}

/// The CA that a client trusts, and its own certificate.
#[derive(Clone)]
pub struct ClientTls(pub(crate) ClientTlsConfig);

// A key must not reach a log.
impl std::fmt::Debug for ClientTls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ClientTls")
    }
}

impl ClientTls {
    /// Reads the CA of the server's certificate, and the client's certificate and key.
    pub fn read(ca: &Path, certificate: Option<&Path>, key: Option<&Path>) -> Result<Self, Failure> {
        let config = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(read("--tls-ca", ca)?));
        match (certificate, key) {
            (Some(certificate), Some(key)) => {
                Ok(Self(config.identity(Identity::from_pem(read("--tls-cert", certificate)?, read("--tls-key", key)?))))
            }
            (None, None) => Ok(Self(config)),
            _ => Err(Failure::usage("the client's certificate and its key belong together: give both or none")),
        }
    }

    /// Reads the files that `MAGEX_TLS_CA`, and optionally `MAGEX_TLS_CERT` and `MAGEX_TLS_KEY`, name.
    pub fn from_env() -> Result<Self, Failure> {
        let path = |name: &str| std::env::var_os(name).map(PathBuf::from);
        let ca = path("MAGEX_TLS_CA")
            .ok_or_else(|| unusable("set MAGEX_TLS_CA to the file of the CA of the service's certificate"))?;
        Self::read(&ca, path("MAGEX_TLS_CERT").as_deref(), path("MAGEX_TLS_KEY").as_deref())
    }
}

/// Certificates that cannot be used.
pub(crate) fn unusable(problem: impl std::fmt::Display) -> Failure {
    Failure::usage(format!("the certificates are unusable: {problem}"))
}

fn read(option: &str, path: &Path) -> Result<String, Failure> {
    let text = crate::options::text_file(option, path)?;
    if !text.contains("-----BEGIN") {
        return Err(Failure::usage(format!("{option} {}: is not a PEM file", path.display())));
    }
    Ok(text)
}
