//! The options of security: certificates, identities, tokens. The same for every service.

use crate::net::auth::Access;
use crate::client::{Settings, Token};
use crate::net::connections::ConnectionLimits;
use crate::exit::Failure;
use crate::server;
use crate::tls::{ClientTls, ServerTls};
use clap::Args;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// How a service guards its port.
#[derive(Debug, Clone, Default)]
pub struct Security {
    /// Certificates; without them nothing is encrypted.
    pub tls: Option<ServerTls>,
    /// Who is let in.
    pub access: Access,
}

/// Options of a service that listens.
#[derive(Debug, Clone, Args, Serialize)]
pub struct ServerArgs {
    /// Certificate chain of this service (PEM); it is also what it shows to services that it calls
    #[arg(long, env = "MAGEX_TLS_CERT", value_name = "FILE", requires = "tls_key", help_heading = "Security")]
    pub tls_cert: Option<PathBuf>,
    /// Key of that certificate (PEM)
    #[arg(long, env = "MAGEX_TLS_KEY", value_name = "FILE", requires = "tls_cert", help_heading = "Security")]
    pub tls_key: Option<PathBuf>,
    /// Authority (PEM) that must have signed the certificate that every caller has to show
    #[arg(long, env = "MAGEX_CLIENT_CA", value_name = "FILE", requires = "tls_cert", help_heading = "Security")]
    pub client_ca: Option<PathBuf>,
    /// Who may call, with which role: a TOML file of `[[identity]]` entries with hashes of tokens and certificates
    #[arg(long, env = "MAGEX_IDENTITIES", value_name = "FILE", help_heading = "Security")]
    pub identities: Option<PathBuf>,
    /// Listen on an address that others can reach without encryption, or without asking who calls; send a token
    /// without encryption
    #[arg(long, env = "MAGEX_INSECURE", help_heading = "Security")]
    pub insecure: bool,
    /// Connections of all callers
    #[arg(long, default_value_t = 2048, value_name = "K", value_parser = clap::value_parser!(u32).range(1..), help_heading = "Limits")]
    pub max_connections: u32,
    /// Connections from one address
    #[arg(long, default_value_t = 1024, value_name = "K", value_parser = clap::value_parser!(u32).range(1..), help_heading = "Limits")]
    pub connections_per_peer: u32,
}

impl Default for ServerArgs {
    fn default() -> Self {
        let most = ConnectionLimits::default();
        Self {
            tls_cert: None,
            tls_key: None,
            client_ca: None,
            identities: None,
            insecure: false,
            max_connections: most.total as u32,
            connections_per_peer: most.per_peer as u32,
        }
    }
}

impl ServerArgs {
    /// How many connections there may be.
    pub fn connections(&self) -> ConnectionLimits {
        let (total, per_peer) = (self.max_connections as usize, self.connections_per_peer as usize);
        ConnectionLimits { total, per_peer, ..ConnectionLimits::default() }
    }

    /// Reads the files that the options name. An address that others can reach needs encryption and callers that are
    /// known, unless that was given up by name.
    ///
    /// # Errors
    /// A file that cannot be used, or an address that is too open: wrong usage.
    pub fn read(&self, listen: &str) -> Result<Security, Failure> {
        let access = self.identities.as_deref().map(Access::read).transpose().map_err(Failure::usage)?;
        let tls = match (&self.tls_cert, &self.tls_key) {
            (Some(certificate), Some(key)) => {
                Some(ServerTls::read(certificate, key, self.client_ca.as_deref()).map_err(Failure::usage)?)
            }
            _ => None,
        };
        if let Some(tls) = &tls {
            server::secure_builder(Some(tls)).map_err(|error| Failure::usage(format!("--tls-cert: {error}")))?;
        }
        let security = Security { tls, access: access.unwrap_or_default() };
        if security.access.needs_certificates() && !security.tls.as_ref().is_some_and(ServerTls::mutual) {
            // Without it no caller is asked for its certificate, and whoever is known by one would be turned away.
            return Err(Failure::usage(
                "--identities: certificate_sha256 needs --client-ca, so that callers show theirs",
            ));
        }
        self.check_exposure(listen, &security)?;
        Ok(security)
    }

    fn check_exposure(&self, listen: &str, security: &Security) -> Result<(), Failure> {
        let address = server::resolve(listen).map_err(Failure::usage)?;
        let known = security.access.restricted() || security.tls.as_ref().is_some_and(ServerTls::mutual);
        if address.ip().is_loopback() || self.insecure || (security.tls.is_some() && known) {
            return Ok(());
        }
        let missing = match (security.tls.is_some(), known) {
            (false, false) => "--tls-cert and --tls-key, and --identities or --client-ca",
            (false, true) => "--tls-cert and --tls-key",
            _ => "--identities or --client-ca",
        };
        Err(Failure::usage(format!(
            "--listen {listen}: others can reach this address; add {missing}, or --insecure to let anybody in"
        )))
    }

    /// Certificate and key, if there are both.
    pub fn own(&self) -> Option<(&Path, &Path)> {
        self.tls_cert.as_deref().zip(self.tls_key.as_deref())
    }
}

/// Options of whoever calls a service. A token itself is no option: command lines are seen by everybody on a machine.
#[derive(Debug, Clone, Default, Args, Serialize)]
pub struct ClientArgs {
    /// Authority (PEM) that signed the certificates of https services
    #[arg(long, env = "MAGEX_TLS_CA", value_name = "FILE", help_heading = "Security")]
    pub tls_ca: Option<PathBuf>,
    /// File with the bearer token that is sent to services; without it the environment variable MAGEX_TOKEN counts
    #[arg(long, env = "MAGEX_TOKEN_FILE", value_name = "FILE", help_heading = "Security")]
    pub token_file: Option<PathBuf>,
}

impl ClientArgs {
    /// Reads the files that the options name, and the token of the environment if there is no file for it. `own` are the
    /// caller's certificate and key; `insecure` lets a token travel without encryption.
    ///
    /// # Errors
    /// A file that cannot be used: wrong usage.
    pub fn read(&self, own: Option<(&Path, &Path)>, insecure: bool) -> Result<Settings, Failure> {
        let tls = match &self.tls_ca {
            Some(ca) => Some(ClientTls::read(ca, own.map(|own| own.0), own.map(|own| own.1)).map_err(Failure::usage)?),
            None => None,
        };
        let token = match &self.token_file {
            Some(path) => Some(Token::read(path)),
            None => std::env::var_os("MAGEX_TOKEN").map(|text| Token::new(&text.to_string_lossy(), "MAGEX_TOKEN")),
        };
        Ok(Settings { tls, token: token.transpose().map_err(Failure::usage)?, insecure })
    }
}

/// Options of a program that calls services and listens nowhere.
#[derive(Debug, Clone, Default, Args, Serialize)]
pub struct CallerArgs {
    /// Whom to trust, and the token.
    #[command(flatten)]
    #[serde(flatten)]
    pub client: ClientArgs,
    /// Certificate chain that is shown to services that ask for one (PEM)
    #[arg(long, env = "MAGEX_TLS_CERT", value_name = "FILE", requires = "tls_key", help_heading = "Security")]
    pub tls_cert: Option<PathBuf>,
    /// Key of that certificate (PEM)
    #[arg(long, env = "MAGEX_TLS_KEY", value_name = "FILE", requires = "tls_cert", help_heading = "Security")]
    pub tls_key: Option<PathBuf>,
    /// Send the token without encryption to other machines too
    #[arg(long, env = "MAGEX_INSECURE", help_heading = "Security")]
    pub insecure: bool,
}

impl CallerArgs {
    /// As [`ClientArgs::read`].
    ///
    /// # Errors
    /// A file that cannot be used: wrong usage.
    pub fn read(&self) -> Result<Settings, Failure> {
        self.client.read(self.tls_cert.as_deref().zip(self.tls_key.as_deref()), self.insecure)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exit::USAGE;

    #[test]
    fn an_address_that_others_reach_asks_for_certificates_and_names() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("who.toml");
        let hash = "a".repeat(64);
        std::fs::write(&path, format!("[[identity]]\nname = 'a'\nrole = 'admin'\ntoken_sha256 = '{hash}'")).unwrap();
        let open = ServerArgs::default();
        let known = ServerArgs { identities: Some(path), ..open.clone() };
        open.read("127.0.0.1:0").unwrap();
        open.read("[::1]:0").unwrap();
        for (args, words) in [(&open, "--tls-key, and --identities"), (&known, "add --tls-cert and --tls-key, or")] {
            let failure = args.read("0.0.0.0:0").unwrap_err();
            assert!(failure.code == USAGE && failure.message.contains(words), "{failure}");
        }
        assert!(known.read("127.0.0.1:0").unwrap().access.restricted());
        ServerArgs { insecure: true, ..open }.read("0.0.0.0:0").unwrap();
    }

    #[test]
    fn who_is_known_by_a_certificate_has_to_be_asked_for_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("who.toml");
        let hash = "a".repeat(64);
        std::fs::write(&path, format!("[[identity]]\nname = 'a'\nrole = 'admin'\ncertificate_sha256 = '{hash}'"))
            .unwrap();
        let failure = ServerArgs { identities: Some(path), ..ServerArgs::default() }.read("127.0.0.1:0").unwrap_err();
        assert!(failure.code == USAGE && failure.message.contains("--client-ca"), "{failure}");
    }

    #[test]
    fn a_token_is_read_from_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        let args = ClientArgs { token_file: Some(path.clone()), ..ClientArgs::default() };
        assert_eq!(args.read(None, false).unwrap_err().code, USAGE);
        std::fs::write(&path, "secret\n").unwrap();
        let settings = args.read(None, false).unwrap();
        assert!(settings.token.is_some() && !format!("{settings:?}").contains("secret"));
    }
}
