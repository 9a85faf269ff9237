//! Certificates: which peers are trusted, and a whole cluster that uses them.

use crate::clients::team;
use crate::sandbox::*;
use crate::security::{bearing, code, identities};
use magex_actor::run::ActorConfig;
use magex_commander::service::ServiceConfig;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::weights::sha256_hex;
use magex_runtime::client::{Settings, endpoint_with};
use magex_runtime::security::Security;
use magex_runtime::tls::{ClientTls, ServerTls};
use std::path::{Path, PathBuf};
use tonic::Code;

/// A certificate and its key in files; signed by `authority`, or an authority itself.
pub(crate) struct Signed {
    certificate: PathBuf,
    key: PathBuf,
    issuer: rcgen::Issuer<'static, rcgen::KeyPair>,
    der: Vec<u8>,
}

pub(crate) fn sign(folder: &Path, name: &str, authority: Option<&Signed>) -> Signed {
    sign_until(folder, name, authority, 4000)
}

/// A certificate that is good until the end of this year.
fn sign_until(folder: &Path, name: &str, authority: Option<&Signed>, year: i32) -> Signed {
    let mut params = rcgen::CertificateParams::new(vec!["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
    params.distinguished_name.push(rcgen::DnType::CommonName, name);
    params.not_after = rcgen::date_time_ymd(year, 12, 31);
    let key = rcgen::KeyPair::generate().unwrap();
    let certificate = match authority {
        Some(authority) => params.signed_by(&key, &authority.issuer).unwrap(),
        None => {
            params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
            params.self_signed(&key).unwrap()
        }
    };
    let (path, key_path) = (folder.join(format!("{name}.pem")), folder.join(format!("{name}.key")));
    std::fs::write(&path, certificate.pem()).unwrap();
    std::fs::write(&key_path, key.serialize_pem()).unwrap();
    let der = certificate.der().to_vec();
    Signed { certificate: path, key: key_path, issuer: rcgen::Issuer::new(params, key), der }
}

impl Signed {
    pub(crate) fn server(&self, client_ca: Option<&Signed>) -> ServerTls {
        ServerTls::read(&self.certificate, &self.key, client_ca.map(|ca| ca.certificate.as_path())).unwrap()
    }
}

/// Trusts this authority and shows this certificate.
pub(crate) fn trusting(authority: &Signed, own: Option<&Signed>) -> ClientTls {
    let (certificate, key) = (own.map(|own| own.certificate.as_path()), own.map(|own| own.key.as_path()));
    ClientTls::read(&authority.certificate, certificate, key).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn certificates_are_asked_for_checked_and_carry_roles() {
    let folder = tempfile::tempdir().unwrap();
    let authority = sign(folder.path(), "authority", None);
    let server = sign(folder.path(), "server", Some(&authority));
    let (robot, actor) =
        (sign(folder.path(), "robot", Some(&authority)), sign(folder.path(), "actor", Some(&authority)));
    let (stranger_ca, unknown) =
        (sign(folder.path(), "elsewhere", None), sign(folder.path(), "unknown", Some(&authority)));
    let stranger = sign(folder.path(), "stranger", Some(&stranger_ca));
    let (robot_hash, actor_hash) = (sha256_hex(&robot.der), sha256_hex(&actor.der));
    let entries =
        [("robot", "client", "certificate", robot_hash.as_str()), ("actor", "actor", "certificate", &actor_hash)];
    let expired = sign_until(folder.path(), "expired", Some(&authority), 2001);
    let tls = server.server(Some(&authority));
    let access = identities(folder.path(), &entries);
    let security = Security { tls: Some(tls), access };
    let config = ServiceConfig { security, ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    let url = commander.url.replace("http://", "https://");
    let ask = async |own: Option<&Signed>, ca: &Signed| {
        let channel = endpoint_with(&url, Some(&trusting(ca, own))).unwrap().connect_lazy();
        within(CommanderServiceClient::new(channel).assign(team())).await
    };
    assert_eq!(code(ask(Some(&robot), &authority).await), None);
    assert_eq!(code(ask(Some(&actor), &authority).await), Some(Code::PermissionDenied));
    assert_eq!(code(ask(Some(&unknown), &authority).await), Some(Code::Unauthenticated));
    // These do not get as far as a call.
    for (own, ca) in
        [(None, &authority), (Some(&stranger), &authority), (Some(&expired), &authority), (Some(&robot), &stranger_ca)]
    {
        let status = ask(own, ca).await.unwrap_err();
        assert!(!matches!(status.code(), Code::Ok | Code::Unauthenticated | Code::PermissionDenied), "{status}");
    }
    // A port that speaks TLS understands nothing else.
    let plain = endpoint_with(&commander.url, None).unwrap().connect_lazy();
    assert!(within(CommanderServiceClient::new(plain).assign(team())).await.is_err());
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cluster_trains_behind_certificates_and_tokens() {
    let folder = tempfile::tempdir().unwrap();
    let authority = sign(folder.path(), "authority", None);
    let server = sign(folder.path(), "server", Some(&authority));
    let hashes = ["rollouts", "goals", "ops"].map(|token| sha256_hex(token.as_bytes()));
    let entries = [
        ("rollouts", "actor", "token", hashes[0].as_str()),
        ("goals", "commander", "token", &hashes[1]),
        ("ops", "admin", "token", &hashes[2]),
    ];
    let access = identities(folder.path(), &entries);
    let guarded = || Security { tls: Some(server.server(None)), access: access.clone() };
    let shown = |token: &str| Settings { tls: Some(trusting(&authority, None)), ..bearing(token) };
    let https = |url: &str| url.replace("http://", "https://");

    let mut learner = Learner::start_with(LearnerOptions { security: guarded(), ..LearnerOptions::default() }).await;
    let learner_url = https(&learner.url);
    let (client, security) = (shown("goals"), guarded());
    let config_ =
        ServiceConfig { learner_url: Some(learner_url.clone()), client, security, ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config_, load_fake).await;
    let (client, commander_url) = (shown("rollouts"), https(&commander.url));
    let config_ = ActorConfig { client, commander_url, ..config(&learner_url, "a") };
    let actor = Actor::start_with(config_, FakeWorker { ask_goals: true, ..FakeWorker::default() });
    assert_eq!(learner.iterate(0, 4).await.unwrap(), expected(&plan(0, 4)));

    // A client without a token, with another role's token, or that trusts another authority is rejected.
    let ask = async |settings: Settings| match settings.connect(&learner_url).await {
        Ok(channel) => code(LearnerServiceClient::new(channel).drain(v1::DrainRequest::default()).await),
        Err(_) => Some(Code::Unavailable),
    };
    assert_eq!(ask(Settings { token: None, ..shown("goals") }).await, Some(Code::Unauthenticated));
    assert_eq!(ask(shown("rollouts")).await, Some(Code::PermissionDenied));
    let elsewhere = sign(folder.path(), "elsewhere", None);
    let wrong = Settings { tls: Some(trusting(&elsewhere, None)), ..shown("ops") };
    assert_eq!(ask(wrong).await, Some(Code::Unavailable));
    assert_eq!(ask(shown("ops")).await, None);
    actor.stop().await;
    commander.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_expired_certificate_is_not_trusted() {
    let folder = tempfile::tempdir().unwrap();
    let authority = sign(folder.path(), "authority", None);
    let (good, over) =
        (sign(folder.path(), "good", Some(&authority)), sign_until(folder.path(), "over", Some(&authority), 2001));
    for (server, expected) in [(&good, true), (&over, false)] {
        let security = Security { tls: Some(server.server(None)), ..Security::default() };
        let learner = Learner::start_with(LearnerOptions { security, ..LearnerOptions::default() }).await;
        let url = learner.url.replace("http://", "https://");
        let settings = Settings { tls: Some(trusting(&authority, None)), ..Settings::default() };
        assert_eq!(settings.connect(&url).await.is_ok(), expected);
        learner.stop().await;
    }
}
