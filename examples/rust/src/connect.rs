//! Connects with the certificates that the environment names.

use anyhow::Context as _;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};

/// A connected channel.
pub(crate) async fn to(url: &str) -> anyhow::Result<Channel> {
    let mut endpoint = Endpoint::from_shared(url.to_owned())?.connect_timeout(std::time::Duration::from_secs(3));
    if let Some(ca) = file("MAGEX_TLS_CA")? {
        let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(ca));
        if let Some((certificate, key)) = file("MAGEX_TLS_CERT")?.zip(file("MAGEX_TLS_KEY")?) {
            tls = tls.identity(Identity::from_pem(certificate, key));
        }
        endpoint = endpoint.tls_config(tls)?;
    }
    endpoint.connect().await.with_context(|| format!("no commander at {url}"))
}

/// The file that a variable of the environment names.
fn file(variable: &str) -> anyhow::Result<Option<Vec<u8>>> {
    let path = std::env::var_os(variable).filter(|path| !path.is_empty());
    path.map(|path| std::fs::read(&path).with_context(|| format!("{variable}: {}", path.display()))).transpose()
}
