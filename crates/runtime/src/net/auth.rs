//! Who is calling, and what for: bearer tokens and client certificates with roles. The same for every service.
//!
//! The file of identities holds no secrets, only SHA-256 of tokens and certificates:
//!
//! ```toml
//! [[identity]]
//! name = "fleet-a"          # owner of its missions, and what limits count
//! role = "client"           # client, actor, commander or admin
//! token_sha256 = "…"        # or certificate_sha256 = "…" (of the DER form)
//! ```

use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use tonic::{Request, Status};

/// What a caller may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Role {
    /// Assignments and missions of its own; how a run stands.
    Client,
    /// Rollouts: leases, weights, the goals of training episodes.
    Actor,
    /// The weights of a run.
    Commander,
    /// Everything, everybody's missions included.
    Admin,
}

/// Who calls.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// Name of the identity: owner of its missions, and what limits count.
    pub name: Arc<str>,
    /// What it may do.
    pub role: Role,
}

/// A file of identities that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {problem}")]
pub struct AccessError {
    path: String,
    problem: String,
}

/// Who is let in.
#[derive(Debug, Clone, Default)]
pub struct Access {
    /// By SHA-256, lower-case hex. `None`: everybody is let in, as far as TLS lets them.
    known: Option<HashMap<String, Caller>>,
    /// Somebody is known by a certificate.
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
    ///
    /// # Errors
    /// A file that cannot be read, or an identity that makes no sense.
    pub fn read(path: &Path) -> Result<Self, AccessError> {
        let wrong = |problem: String| AccessError { path: path.display().to_string(), problem };
        let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
        Self::parse(&text).map_err(wrong)
    }

    fn parse(text: &str) -> Result<Self, String> {
        let file: File = toml::from_str(text).map_err(|error| error.to_string())?;
        if file.identity.is_empty() {
            return Err("no [[identity]]: nobody could call".to_owned());
        }
        let (mut known, mut certificates) = (HashMap::new(), false);
        for (k, identity) in file.identity.into_iter().enumerate() {
            let place = format!("identity[{k}]");
            if identity.name.is_empty() {
                return Err(format!("{place}.name: empty"));
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
        Ok(Self { known: Some(known), certificates })
    }

    /// Callers must show who they are.
    pub fn restricted(&self) -> bool {
        self.known.is_some()
    }

    /// Somebody is known by a certificate: callers have to be asked for theirs.
    pub fn needs_certificates(&self) -> bool {
        self.certificates
    }

    /// Who makes this call.
    ///
    /// # Errors
    /// UNAUTHENTICATED: nobody who is known here.
    pub fn identify<T>(&self, request: &Request<T>) -> Result<Caller, Status> {
        let certificate = request.peer_certs().and_then(|chain| chain.first().map(|leaf| sha256_hex(leaf.as_ref())));
        let Some(known) = &self.known else {
            let name = match (&certificate, request.remote_addr()) {
                (Some(hash), _) => format!("certificate-{}", &hash[..16]),
                (None, Some(address)) => address.ip().to_string(),
                (None, None) => "local".to_owned(),
            };
            return Ok(Caller { name: name.into(), role: Role::Admin });
        };
        if let Some(value) = request.metadata().get("authorization") {
            // Only digests are compared, so the time it takes says nothing about a token.
            let token = value.to_str().ok().and_then(|text| text.strip_prefix("Bearer "));
            let caller = token.and_then(|token| known.get(&sha256_hex(token.trim().as_bytes())));
            return caller.cloned().ok_or_else(|| Status::unauthenticated("this bearer token is not known here"));
        }
        let caller = certificate.and_then(|hash| known.get(&hash));
        caller.cloned().ok_or_else(|| {
            Status::unauthenticated(
                "send 'authorization: Bearer TOKEN', or use a client certificate that is known here",
            )
        })
    }
}

/// The caller of a request that came through the door, if it may do this. Admins may do everything.
///
/// # Errors
/// PERMISSION_DENIED: it has another role.
pub fn caller<T>(request: &Request<T>, allowed: &[Role]) -> Result<Caller, Status> {
    let Some(caller) = request.extensions().get::<Caller>() else {
        return Err(Status::internal("a call came in without its caller"));
    };
    if caller.role == Role::Admin || allowed.contains(&caller.role) {
        return Ok(caller.clone());
    }
    let role = format!("{:?}", caller.role).to_lowercase();
    Err(Status::permission_denied(format!("'{}' has the role {role}, which may not do this", caller.name)))
}

/// SHA-256 as lower-case hex.
fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_known_by_their_hash() {
        let hash = sha256_hex(b"secret");
        let text = format!("[[identity]]\nname = 'a'\nrole = 'client'\ntoken_sha256 = '{}'", hash.to_uppercase());
        let access = Access::parse(&text).unwrap();
        let ask = |value: Option<&str>| {
            let mut request = Request::new(());
            if let Some(value) = value {
                request.metadata_mut().insert("authorization", value.parse().unwrap());
            }
            access.identify(&request)
        };
        let caller = ask(Some("Bearer secret")).unwrap();
        assert_eq!((&*caller.name, caller.role), ("a", Role::Client));
        for wrong in [None, Some("Bearer Secret"), Some("secret"), Some("Bearer "), Some("Basic secret")] {
            assert_eq!(ask(wrong).unwrap_err().code(), tonic::Code::Unauthenticated, "{wrong:?}");
        }
        assert_eq!(Access::default().identify(&Request::new(())).unwrap().role, Role::Admin);
    }

    #[test]
    fn roles_open_only_their_doors() {
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
    fn files_that_make_no_sense_are_refused() {
        for (text, words) in [
            ("", "nobody could call"),
            ("[[identity]]\nname = 'a'\nrole = 'king'", "unknown variant"),
            ("[[identity]]\nname = 'a'\nrole = 'client'", "identity[0]: give either"),
            ("[[identity]]\nname = 'a'\nrole = 'client'\ntoken_sha256 = 'abc'", "64 hexadecimal"),
            ("[[identity]]\nname = ''\nrole = 'client'\ntoken_sha256 = 'abc'", "identity[0].name"),
            ("[[identity]]\nname = 'a'\nrole = 'client'\ntoken = 'abc'", "unknown field"),
        ] {
            let error = Access::parse(text).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
    }
}
