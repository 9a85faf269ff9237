//! Connecting to a service.

use crate::tls::ClientTls;
use std::time::Duration;
use tonic::transport::{Channel, Endpoint};

/// A url that cannot be connected to, whatever runs there.
#[derive(Debug, thiserror::Error)]
#[error("'{url}' is not an address to connect to ({reason}): use the form http://host:port, or https://host:port")]
pub struct UrlError {
    url: String,
    reason: String,
}

/// An endpoint with our settings. For an https url the certificates are those that the environment names
/// ([`ClientTls::from_env`]).
pub fn endpoint(url: &str) -> Result<Endpoint, UrlError> {
    let secure = url.trim_start().to_ascii_lowercase().starts_with("https:");
    let tls = secure.then(ClientTls::from_env).transpose();
    let tls = tls.map_err(|error| UrlError { url: url.to_owned(), reason: error.to_string() })?;
    endpoint_with(url, tls.as_ref())
}

/// An endpoint with our settings: a peer that is gone is noticed within 15 s even when nothing is being said.
pub fn endpoint_with(url: &str, tls: Option<&ClientTls>) -> Result<Endpoint, UrlError> {
    let wrong = |reason: String| UrlError { url: url.to_owned(), reason };
    let endpoint = Endpoint::from_shared(url.to_owned()).map_err(|error| wrong(error.to_string()))?;
    let endpoint = match (endpoint.uri().scheme_str(), tls) {
        (Some("http"), None) if endpoint.uri().host().is_some() => endpoint,
        (Some("https"), Some(tls)) if endpoint.uri().host().is_some() => {
            endpoint.tls_config(tls.config()).map_err(|error| wrong(error.to_string()))?
        }
        (Some("http"), Some(_)) => return Err(wrong("certificates need an https url".to_owned())),
        (Some("https"), None) => return Err(wrong("https needs certificates".to_owned())),
        _ => return Err(wrong("not an http url".to_owned())),
    };
    Ok(endpoint
        .connect_timeout(Duration::from_secs(3))
        .tcp_nodelay(true)
        .http2_keep_alive_interval(Duration::from_secs(10))
        .keep_alive_timeout(Duration::from_secs(5))
        .keep_alive_while_idle(true)
        .initial_stream_window_size(8 << 20)
        .initial_connection_window_size(16 << 20))
}

/// A channel that connects with the first call and again whenever it is broken.
pub fn lazy_channel(url: &str) -> Result<Channel, UrlError> {
    Ok(endpoint(url)?.connect_lazy())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_url_without_scheme_is_refused_with_the_form() {
        for url in ["", "localhost:7000", "127.0.0.1:7000", "ftp://x:1", "http://"] {
            let error = endpoint(url).unwrap_err().to_string();
            assert!(error.contains("http://host:port"), "{error}");
        }
        endpoint("http://localhost:7000").unwrap();
    }
}
