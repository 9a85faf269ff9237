//! The security options of every service: certificates, identities, tokens.

use crate::client::{Settings, Token};
use crate::exit::Failure;
use crate::net::auth::{Access, NEEDS_CLIENT_CA};
use crate::net::connections::ConnectionLimits;
use crate::options;
use crate::reload::Source;
use crate::server;
use crate::tls::{ClientTls, ServerTls};
use clap::Args;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The security of a service's port.
#[derive(Debug, Clone, Default)]
pub struct Security {
    /// Certificates; without them connections are not encrypted.
    pub tls: Option<ServerTls>,
    /// The identities that may call.
    pub access: Access,
}

impl Security {
    /// Every client must present a certificate.
    fn mutual(&self) -> bool {
        self.tls.as_ref().is_some_and(ServerTls::mutual)
    }

    /// What can be read again while the service runs.
    pub fn sources(&self) -> Vec<Source> {
        let (mutual, access) = (self.mutual(), self.access.clone());
        let tls = self.tls.clone().map(|tls| {
            let (files, again, ends) = (tls.files(), tls.clone(), tls);
            Source::new("the service's certificate", files, move || again.reload()).ending(move || ends.ends())
        });
        let identities = self.access.path().map(|path| vec![path.to_owned()]);
        let identities = identities.map(|files| Source::new("the identities", files, move || access.reload(mutual)));
        tls.into_iter().chain(identities).collect()
    }
}

/// Options of a service that listens.
#[derive(Debug, Clone, Args, Serialize)]
pub struct ServerArgs {
    /// Certificate chain of this service (PEM), also used as a client certificate
    #[arg(long, env = "MAGEX_TLS_CERT", value_name = "FILE", requires = "tls_key", help_heading = "Security")]
    pub tls_cert: Option<PathBuf>,
    /// Key of that certificate (PEM)
    #[arg(long, env = "MAGEX_TLS_KEY", value_name = "FILE", requires = "tls_cert", help_heading = "Security")]
    pub tls_key: Option<PathBuf>,
    /// CA (PEM) of client certificates; with it every caller must present one
    #[arg(long, env = "MAGEX_CLIENT_CA", value_name = "FILE", requires = "tls_cert", help_heading = "Security")]
    pub client_ca: Option<PathBuf>,
    /// Identities that may call, with their roles: a TOML file of `[[identity]]` entries with hashes of tokens and certificates
    #[arg(long, env = "MAGEX_IDENTITIES", value_name = "FILE", help_heading = "Security")]
    pub identities: Option<PathBuf>,
    /// Allow a non-loopback address without TLS or without authentication, and allow sending a token without TLS
    #[arg(long, env = "MAGEX_INSECURE", value_parser = options::switch, help_heading = "Security")]
    pub insecure: bool,
    /// Maximum number of connections
    #[arg(long, default_value_t = 2048, value_name = "K", value_parser = options::whole::<u32>(1, 1_000_000), help_heading = "Limits")]
    pub max_connections: u32,
    /// Maximum number of connections from one IP address
    #[arg(long, default_value_t = 1024, value_name = "K", value_parser = options::whole::<u32>(1, 1_000_000), help_heading = "Limits")]
    pub connections_per_peer: u32,
    /// Seconds between heartbeats on server streams, so that balancers keep quiet ones open; 0 for none
    #[arg(long, env = "MAGEX_HEARTBEAT", default_value_t = 30, value_name = "SECONDS", value_parser = options::whole::<u32>(0, 3600), help_heading = "Limits")]
    pub heartbeat: u32,
}

impl ServerArgs {
    /// Limits of the connections.
    pub fn connections(&self) -> ConnectionLimits {
        let (total, per_peer) = (self.max_connections as usize, self.connections_per_peer as usize);
        ConnectionLimits { total, per_peer, ..ConnectionLimits::default() }
    }

    /// Time between heartbeats on server streams, if there are any.
    pub fn heartbeat(&self) -> Option<Duration> {
        (self.heartbeat > 0).then(|| Duration::from_secs(self.heartbeat.into()))
    }

    /// Reads the files of the options. A non-loopback address needs TLS and authentication, unless `--insecure` is given.
    pub fn read(&self, listen: &str) -> Result<Security, Failure> {
        let access = self.identities.as_deref().map(Access::read).transpose()?;
        let read = |(certificate, key)| ServerTls::read(certificate, key, self.client_ca.as_deref());
        let tls = self.own().map(read).transpose()?;
        let security = Security { tls, access: access.unwrap_or_default() };
        if security.access.certificates() && !security.mutual() {
            // Without it no client certificate is requested, so those identities could not authenticate.
            return Err(Failure::usage(NEEDS_CLIENT_CA));
        }
        self.check_exposure(listen, &security)?;
        Ok(security)
    }

    fn check_exposure(&self, listen: &str, security: &Security) -> Result<(), Failure> {
        let address = server::resolve(listen)?;
        let known = security.access.restricted() || security.mutual();
        if address.ip().is_loopback() || self.insecure || (security.tls.is_some() && known) {
            return Ok(());
        }
        let missing = match (security.tls.is_some(), known) {
            (false, false) => "--tls-cert and --tls-key, and --identities or --client-ca",
            (false, true) => "--tls-cert and --tls-key",
            _ => "--identities or --client-ca",
        };
        Err(Failure::usage(format!(
            "--listen {listen}: other machines can reach this address; add {missing}, or --insecure to accept any client"
        )))
    }

    /// Certificate and key, if both are given.
    pub fn own(&self) -> Option<(&Path, &Path)> {
        self.tls_cert.as_deref().zip(self.tls_key.as_deref())
    }
}

/// Options of a client of a service. A token itself is no option, because command lines are visible to all users of a machine.
#[derive(Debug, Clone, Default, Args, Serialize)]
pub struct ClientArgs {
    /// CA (PEM) of the certificates of https services
    #[arg(long, env = "MAGEX_TLS_CA", value_name = "FILE", help_heading = "Security")]
    pub tls_ca: Option<PathBuf>,
    /// File with the bearer token for services [default: the environment variable MAGEX_TOKEN]
    #[arg(long, env = "MAGEX_TOKEN_FILE", value_name = "FILE", help_heading = "Security")]
    pub token_file: Option<PathBuf>,
}

impl ClientArgs {
    /// Reads the files that the options name, or the token of the environment without a token file. `own` are the client's
    /// certificate and key; `insecure` allows sending a token without TLS.
    pub fn read(&self, own: Option<(&Path, &Path)>, insecure: bool) -> Result<Settings, Failure> {
        let (certificate, key) = own.unzip();
        let tls = self.tls_ca.as_deref().map(|ca| ClientTls::read(ca, certificate, key)).transpose()?;
        let token = match &self.token_file {
            Some(path) => Some(Token::read(path)),
            None => std::env::var_os("MAGEX_TOKEN").map(|text| Token::new(&text.to_string_lossy(), "MAGEX_TOKEN")),
        };
        Ok(Settings { tls, token: token.transpose()?, insecure })
    }
}

/// Options of a client that does not listen itself.
#[derive(Debug, Clone, Default, Args, Serialize)]
pub struct CallerArgs {
    /// CA and token.
    #[command(flatten)]
    #[serde(flatten)]
    pub client: ClientArgs,
    /// Client certificate chain (PEM)
    #[arg(long, env = "MAGEX_TLS_CERT", value_name = "FILE", requires = "tls_key", help_heading = "Security")]
    pub tls_cert: Option<PathBuf>,
    /// Key of that certificate (PEM)
    #[arg(long, env = "MAGEX_TLS_KEY", value_name = "FILE", requires = "tls_cert", help_heading = "Security")]
    pub tls_key: Option<PathBuf>,
    /// Allow sending the token without TLS to other machines
    #[arg(long, env = "MAGEX_INSECURE", value_parser = options::switch, help_heading = "Security")]
    pub insecure: bool,
}

impl CallerArgs {
    /// As [`ClientArgs::read`].
    pub fn read(&self) -> Result<Settings, Failure> {
        if self.tls_cert.is_some() && self.client.tls_ca.is_none() {
            return Err(Failure::usage(
                "--tls-cert: a client's certificate needs --tls-ca, the CA of the services that see it",
            ));
        }
        self.client.read(self.tls_cert.as_deref().zip(self.tls_key.as_deref()), self.insecure)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exit::USAGE;
    use clap::Parser as _;

    #[derive(clap::Parser)]
    struct Command {
        #[command(flatten)]
        args: ServerArgs,
    }

    fn defaults() -> ServerArgs {
        Command::parse_from(["test"]).args
    }

    #[test]
    fn an_exposed_address_needs_certificates_and_identities() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("identities.toml");
        let hash = "a".repeat(64);
        std::fs::write(&path, format!("[[identity]]\nname = 'a'\nrole = 'admin'\ntoken_sha256 = '{hash}'")).unwrap();
        let open = defaults();
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
    fn identities_by_certificate_need_a_client_ca() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("identities.toml");
        let hash = "a".repeat(64);
        std::fs::write(&path, format!("[[identity]]\nname = 'a'\nrole = 'admin'\ncertificate_sha256 = '{hash}'"))
            .unwrap();
        let failure = ServerArgs { identities: Some(path), ..defaults() }.read("127.0.0.1:0").unwrap_err();
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
