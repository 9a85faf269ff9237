//! When a certificate ends.

use std::time::Duration;
use tokio_rustls::rustls::client::WebPkiServerVerifier;
use tokio_rustls::rustls::client::danger::ServerCertVerifier as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use tokio_rustls::rustls::{CertificateError, Error, RootCertStore};

/// Later than any certificate, since 1970.
const NEVER: Duration = Duration::from_secs(1 << 50);

/// The end of a certificate's validity, since 1970. rustls gives the date only when it refuses a certificate that has ended,
/// so this asks it for a verdict at the end of time. The other checks come later and do not matter.
pub(super) fn end(certificate: &CertificateDer<'static>) -> Option<Duration> {
    let mut roots = RootCertStore::empty();
    roots.add(certificate.clone()).ok()?;
    let verifier = WebPkiServerVerifier::builder(roots.into()).build().ok()?;
    let name = ServerName::try_from("localhost").ok()?;
    match verifier.verify_server_cert(certificate, &[], &name, &[], UnixTime::since_unix_epoch(NEVER)) {
        Err(Error::InvalidCertificate(CertificateError::ExpiredContext { not_after, .. })) => {
            Some(Duration::from_secs(not_after.as_secs()))
        }
        _ => None,
    }
}

/// The time of day, since 1970: certificates are good by the clock on the wall.
pub(crate) fn time_of_day() -> Duration {
    Duration::from_secs(UnixTime::now().as_secs())
}
