//! Authentication by bearer token or client certificate, and authorisation by role. The same for every service.
//!
//! The file of identities holds no secrets, only the SHA-256 of tokens and certificates:
//!
//! ```toml
//! [[identity]]
//! name = "fleet-a"          # owns missions; limits are counted per name
//! role = "client"           # client, actor, commander or admin
//! token_sha256 = "…"        # or certificate_sha256 = "…" (of the DER form)
//! ```

use crate::exit::Failure;
use crate::sync::Live;
use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use std::collections::HashMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use tonic::codegen::http;
use tonic::{Request, Status};

pub(crate) const NEEDS_CLIENT_CA: &str =
    "--identities: certificate_sha256 needs --client-ca, so that callers present their certificates";

/// What a caller may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Role {
    /// Assignments, its own missions, and the status of a run.
    Client,
    /// Rollouts: leases, weights, the goals of training episodes.
    Actor,
    /// The weights of a run.
    Commander,
    /// Everything, including the missions of all clients.
    Admin,
}

/// The authenticated origin of a call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// Name of the identity: owns missions, and limits are counted per name.
    pub name: Arc<str>,
    /// Its permissions.
    pub role: Role,
}

/// The caller of a call, as its connection shows it.
#[derive(Debug, Clone)]
pub struct Peer {
    /// Its address.
    pub address: SocketAddr,
    /// SHA-256 of its certificate (DER), lower-case hex.
    pub certificate: Option<Arc<str>>,
}

/// The identities that may call. They can be read again while they are in use; the next call of a caller counts.
#[derive(Debug, Clone, Default)]
pub struct Access {
    /// Their file. Without one every caller that passes TLS is an admin.
    path: Option<Arc<Path>>,
    live: Live<Identities>,
}

#[derive(Debug, Default)]
struct Identities {
    /// By SHA-256, lower-case hex.
    known: HashMap<String, Caller>,
    /// At least one identity is known by its certificate, so the server must request client certificates.
    certificates: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    identity: Vec<Identity>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Identity {
    name: String,
    role: Role,
    token_sha256: Option<String>,
    certificate_sha256: Option<String>,
}

impl Access {
    /// Reads a file of identities.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        Ok(Self { path: Some(path.into()), live: Live::new(Identities::read(path)?) })
    }

    /// Reads the file again. If it cannot be used, nothing changes. `mutual` says whether client certificates are requested.
    pub(crate) fn reload(&self, mutual: bool) -> Result<(), Failure> {
        let Some(path) = &self.path else { return Ok(()) };
        let identities = Identities::read(path)?;
        if identities.certificates && !mutual {
            return Err(Failure::usage(NEEDS_CLIENT_CA));
        }
        self.live.set(identities);
        Ok(())
    }

    /// The file of the identities.
    pub(crate) fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// At least one identity is known by its certificate.
    pub(crate) fn certificates(&self) -> bool {
        self.live.get().certificates
    }

    /// Callers must authenticate.
    pub fn restricted(&self) -> bool {
        self.path.is_some()
    }

    /// Authenticates a call by its `authorization` header, or else by its client certificate.
    /// Missing or unknown credentials are UNAUTHENTICATED.
    pub fn authenticate<T>(&self, request: &http::Request<T>) -> Result<Caller, Status> {
        let peer = request.extensions().get::<Peer>();
        let certificate = peer.and_then(|peer| peer.certificate.as_deref());
        if !self.restricted() {
            let name = match (certificate, peer) {
                (Some(hash), _) => format!("certificate-{}", &hash[..16]),
                (None, Some(peer)) => peer.address.ip().to_string(),
                (None, None) => "local".to_owned(),
            };
            return Ok(Caller { name: name.into(), role: Role::Admin });
        }
        let identities = self.live.get();
        let known = &identities.known;
        if let Some(value) = request.headers().get("authorization") {
            // Only digests are compared, so the duration reveals nothing about a token.
            let token = value.to_str().ok().and_then(|text| text.strip_prefix("Bearer "));
            let caller = token.and_then(|token| known.get(&sha256_hex(token.trim().as_bytes())));
            return caller.cloned().ok_or_else(|| {
                Status::unauthenticated(
                    "authorization: unknown bearer token; check the token, or add its SHA-256 to --identities",
                )
            });
        }
        let caller = certificate.and_then(|hash| known.get(hash));
        caller.cloned().ok_or_else(|| {
            Status::unauthenticated(
                "authorization: missing; send 'authorization: Bearer TOKEN', or connect with a client certificate listed in --identities",
            )
        })
    }
}

impl Identities {
    fn read(path: &Path) -> Result<Self, Failure> {
        Self::parse(&crate::options::text_file("--identities", path)?)
            .map_err(|problem| Failure::usage(format!("--identities {}: {problem}", path.display())))
    }

    fn parse(text: &str) -> Result<Self, String> {
        let file: File = toml::from_str(text).map_err(|error| crate::options::toml_problem(text, &error))?;
        if file.identity.is_empty() {
            return Err(
                "identity: the file has no [[identity]] entry, so no caller could authenticate; add one".to_owned()
            );
        }
        let (mut known, mut certificates) = (HashMap::new(), false);
        for (k, identity) in file.identity.into_iter().enumerate() {
            let place = format!("identity[{k}]");
            if identity.name.is_empty() {
                return Err(format!("{place}.name: empty; give the identity a name"));
            }
            certificates |= identity.certificate_sha256.is_some();
            let hash = match (identity.token_sha256, identity.certificate_sha256) {
                (Some(hash), None) | (None, Some(hash)) => hash.to_ascii_lowercase().replace(':', ""),
                _ => return Err(format!("{place}: give either token_sha256 or certificate_sha256")),
            };
            if hash.len() != 64 || !hash.bytes().all(|byte| byte.is_ascii_hexdigit()) {
                return Err(format!("{place}: a SHA-256 has 64 hexadecimal digits"));
            }
            let caller = Caller { name: identity.name.into(), role: identity.role };
            if known.insert(hash, caller).is_some() {
                return Err(format!("{place}: the same SHA-256 occurs before"));
            }
        }
        Ok(Self { known, certificates })
    }
}

/// The caller of a request, if its role is among `allowed` or admin; otherwise PERMISSION_DENIED.
pub fn caller<T>(request: &Request<T>, allowed: &[Role]) -> Result<Caller, Status> {
    let Some(caller) = request.extensions().get::<Caller>() else {
        return Err(Status::internal("the call was not authenticated"));
    };
    if caller.role == Role::Admin || allowed.contains(&caller.role) {
        return Ok(caller.clone());
    }
    let role = format!("{:?}", caller.role).to_lowercase();
    Err(Status::permission_denied(format!("'{}' has the role {role}, which may not call this method", caller.name)))
}

/// The address that a call comes from; `None` in process.
pub fn peer_address(extensions: &http::Extensions) -> Option<SocketAddr> {
    extensions.get::<Peer>().map(|peer| peer.address)
}

/// SHA-256 as lower-case hex.
pub(super) fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_authenticate_by_their_hash() {
        let hash = sha256_hex(b"secret");
        let text = format!("[[identity]]\nname = 'a'\nrole = 'client'\ntoken_sha256 = '{}'", hash.to_uppercase());
        let access = Access { path: Some(Path::new("x").into()), live: Live::new(Identities::parse(&text).unwrap()) };
        let ask = |value: Option<&str>| {
            let mut request = http::Request::new(());
            if let Some(value) = value {
                request.headers_mut().insert("authorization", value.parse().unwrap());
            }
            access.authenticate(&request)
        };
        let caller = ask(Some("Bearer secret")).unwrap();
        assert_eq!((&*caller.name, caller.role), ("a", Role::Client));
        for wrong in [None, Some("Bearer Secret"), Some("secret"), Some("Bearer "), Some("Basic secret")] {
            assert_eq!(ask(wrong).unwrap_err().code(), tonic::Code::Unauthenticated, "{wrong:?}");
        }
        assert_eq!(Access::default().authenticate(&http::Request::new(())).unwrap().role, Role::Admin);
    }

    #[test]
    fn a_role_may_call_only_its_own_methods() {
        let mut request = Request::new(());
        request.extensions_mut().insert(Caller { name: "a".into(), role: Role::Actor });
        assert!(caller(&request, &[Role::Actor]).is_ok());
        let refused = caller(&request, &[Role::Client, Role::Commander]).unwrap_err();
        assert!(
            refused.code() == tonic::Code::PermissionDenied && refused.message().contains("role actor"),
            "{refused}"
        );
        assert_eq!(caller(&Request::new(()), &[Role::Client]).unwrap_err().code(), tonic::Code::Internal);
    }

    #[test]
    fn invalid_files_are_rejected() {
        for (text, words) in [
            ("", "no [[identity]]"),
            ("[[identity]]\nname = 'a'\nrole = 'king'", "unknown name 'king'"),
            ("[[identity]]\nname = 'a'\nrole = 'client'", "identity[0]: give either"),
            ("[[identity]]\nname = 'a'\nrole = 'client'\ntoken_sha256 = 'abc'", "64 hexadecimal"),
            ("[[identity]]\nname = ''\nrole = 'client'\ntoken_sha256 = 'abc'", "identity[0].name"),
            ("[[identity]]\nname = 'a'\nrole = 'client'\ntoken = 'abc'", "unknown key"),
        ] {
            let error = Identities::parse(text).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
    }
}
