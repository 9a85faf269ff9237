//! PEM files of certificates and keys: an error says which file it is, what is in it, and what belongs there.

use crate::exit::Failure;
use std::path::{Path, PathBuf};
use tokio_rustls::rustls::pki_types::pem::{PemObject as _, SectionKind};
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};

/// A file that an option (or a variable of the environment) names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct NamedFile {
    pub(crate) option: &'static str,
    pub(crate) path: PathBuf,
}

impl NamedFile {
    pub(crate) fn new(option: &'static str, path: &Path) -> Self {
        Self { option, path: path.to_owned() }
    }

    /// Wrong usage: what is wrong with this file.
    pub(crate) fn wrong(&self, problem: impl std::fmt::Display) -> Failure {
        Failure::usage(format!("{} {}: {problem}", self.option, self.path.display()))
    }

    fn read(&self) -> Result<Vec<u8>, Failure> {
        if self.path.is_dir() {
            return Err(self.wrong("a folder; give a PEM file"));
        }
        std::fs::read(&self.path).map_err(|error| self.wrong(error))
    }

    /// All certificates in the file; there must be one.
    pub(crate) fn certificates(&self) -> Result<Vec<CertificateDer<'static>>, Failure> {
        let bytes = self.read()?;
        let of = |(kind, der)| (kind == SectionKind::Certificate).then(|| CertificateDer::from(der));
        let found: Vec<_> = self.sections(&bytes)?.into_iter().filter_map(of).collect();
        match found.is_empty() {
            true => Err(self.wrong(format!("{}; a certificate (PEM) belongs here", holds(&bytes)))),
            false => Ok(found),
        }
    }

    /// The first private key in the file.
    pub(crate) fn key(&self) -> Result<PrivateKeyDer<'static>, Failure> {
        let bytes = self.read()?;
        if is_encrypted(&bytes) {
            let path = self.path.display();
            let remedy = "a service cannot ask for its passphrase; decrypt it with";
            return Err(self.wrong(format!("the key is encrypted; {remedy} openssl pkey -in {path} -out NEW-FILE")));
        }
        let key = self.sections(&bytes)?.into_iter().find_map(|(kind, der)| PrivateKeyDer::from_pem(kind, der));
        key.ok_or_else(|| self.wrong(format!("{}; a private key (PEM) belongs here", holds(&bytes))))
    }

    fn sections(&self, bytes: &[u8]) -> Result<Vec<(SectionKind, Vec<u8>)>, Failure> {
        let sections: Result<_, _> = <(SectionKind, Vec<u8>)>::pem_slice_iter(bytes).collect();
        sections.map_err(|error| self.wrong(format!("damaged PEM: {error}")))
    }
}

fn is_encrypted(bytes: &[u8]) -> bool {
    let text = String::from_utf8_lossy(bytes);
    text.contains("BEGIN ENCRYPTED PRIVATE KEY") || text.contains("Proc-Type: 4,ENCRYPTED")
}

/// What a file holds in place of what belongs there.
fn holds(bytes: &[u8]) -> &'static str {
    let text = String::from_utf8_lossy(bytes);
    match () {
        () if bytes.is_empty() => "the file is empty",
        () if text.contains("PRIVATE KEY-----") => {
            "the file holds a private key and no certificate (are certificate and key exchanged?)"
        }
        () if text.contains("BEGIN CERTIFICATE-----") => {
            "the file holds a certificate and no private key (are certificate and key exchanged?)"
        }
        () if text.contains("BEGIN CERTIFICATE REQUEST") => "the file holds a certificate request, not yet signed",
        () if text.contains("BEGIN PUBLIC KEY") => "the file holds a public key",
        () if bytes.starts_with(&[0x30, 0x82]) || bytes.starts_with(&[0x30, 0x81]) => {
            "the file is DER, not PEM (convert it with openssl x509 or openssl pkey, -inform der)"
        }
        () => "the file is not PEM",
    }
}
