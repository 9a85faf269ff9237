//! Who is let in: tokens, certificates, roles and limits.

use crate::clients::{positions, team};
use crate::sandbox::*;
use magex_commander::access::Access;
use magex_commander::service::CommanderConfig;
use magex_dispatch::Limits;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_proto::weights::sha256_hex;
use magex_runtime::client::endpoint_with;
use magex_runtime::tls::{ClientTls, ServerTls};
use std::path::{Path, PathBuf};
use tonic::metadata::MetadataValue;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Channel;
use tonic::{Code, Request, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

type Client<F> = CommanderServiceClient<InterceptedService<Channel, F>>;

fn identities(folder: &Path, entries: &[(&str, &str, &str, &str)]) -> Access {
    let mut text = String::new();
    for (name, role, kind, hash) in entries {
        text += &format!("[[identity]]\nname = '{name}'\nrole = '{role}'\n{kind}_sha256 = '{hash}'\n");
    }
    let path = folder.join("identities.toml");
    std::fs::write(&path, text).unwrap();
    Access::read(&path).unwrap()
}

fn bearing(channel: Channel, token: &str) -> Client<impl FnMut(Request<()>) -> Result<Request<()>, Status> + Clone> {
    let value: MetadataValue<_> = format!("Bearer {token}").parse().unwrap();
    CommanderServiceClient::with_interceptor(channel, move |mut request: Request<()>| {
        request.metadata_mut().insert("authorization", value.clone());
        Ok(request)
    })
}

fn code<T>(result: Result<T, Status>) -> Option<Code> {
    result.err().map(|status| status.code())
}

#[tokio::test(flavor = "multi_thread")]
async fn every_role_opens_its_own_doors_and_missions_are_their_owners() {
    let folder = tempfile::tempdir().unwrap();
    let hash = |token: &str| sha256_hex(token.as_bytes());
    let (client, other, actor, admin) = (hash("c"), hash("o"), hash("a"), hash("x"));
    let entries = [
        ("fleet", "client", "token", client.as_str()),
        ("other", "client", "token", other.as_str()),
        ("rollouts", "actor", "token", actor.as_str()),
        ("ops", "admin", "token", admin.as_str()),
    ];
    let config = CommanderConfig { access: identities(folder.path(), &entries), ..CommanderConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    let channel = magex_runtime::client::endpoint(&commander.url).unwrap().connect().await.unwrap();
    let shard = plan(0, 1)[0];
    let key = magex_proto::goals::WeightsKey {
        run_id: magex_core::ids::RunId("r".into()),
        version: shard.version,
        sha256: String::new(),
    };
    let batch = || {
        let mut request = goal_request(&task(), &shard);
        request.scheduler = magex_proto::goals::SchedulerKind::Exact;
        request.to_message(&key)
    };
    // Token, and what Assign, AssignBatch, GetModel and CreateMission answer.
    let (denied, unknown) = (Some(Code::PermissionDenied), Some(Code::Unauthenticated));
    for (token, expected) in [
        ("c", [None, denied, None, None]),
        ("o", [None, denied, None, None]),
        ("a", [denied, None, None, denied]),
        ("x", [None, None, None, None]),
        ("wrong", [unknown; 4]),
    ] {
        let mut client = bearing(channel.clone(), token);
        let mission = v1::CreateMissionRequest { mission_id: format!("of-{token}"), ..Default::default() };
        let found = [
            code(client.assign(team()).await),
            code(client.assign_batch(batch()).await),
            code(client.get_model(v1::GetModelRequest {}).await),
            code(client.create_mission(mission).await),
        ];
        assert_eq!(found, expected, "{token}");
    }
    let mut nobody = CommanderServiceClient::new(channel.clone());
    assert_eq!(code(nobody.assign(team()).await), unknown);
    // Health needs no token.
    let mut health = HealthClient::new(channel.clone());
    health.check(HealthCheckRequest { service: String::new() }).await.unwrap();
    for (token, missions) in [("c", vec!["of-c"]), ("o", vec!["of-o"]), ("x", vec!["of-c", "of-o", "of-x"])] {
        let mut client = bearing(channel.clone(), token);
        let own = v1::ListAssignmentsRequest { source: v1::MissionSource::Client.into(), ..Default::default() };
        let page = client.list_assignments(own).await.unwrap().into_inner();
        let names: Vec<&str> = page.assignments.iter().map(|a| a.mission_id.as_str()).collect();
        assert_eq!(names, missions, "{token}");
        let theirs = v1::DeleteMissionRequest { mission_id: if token == "c" { "of-o" } else { "of-c" }.into() };
        let expected = if token == "x" { None } else { Some(Code::NotFound) };
        assert_eq!(code(client.delete_mission(theirs).await), expected, "{token}");
    }
    commander.stop().await;
}

/// A certificate and its key in files; signed by `authority`, or an authority itself.
struct Signed {
    certificate: PathBuf,
    key: PathBuf,
    issuer: rcgen::Issuer<'static, rcgen::KeyPair>,
    der: Vec<u8>,
}

fn sign(folder: &Path, name: &str, authority: Option<&Signed>) -> Signed {
    let mut params = rcgen::CertificateParams::new(vec!["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
    params.distinguished_name.push(rcgen::DnType::CommonName, name);
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
    let tls = ServerTls::read(&server.certificate, &server.key, Some(&authority.certificate)).unwrap();
    let access = identities(folder.path(), &entries);
    let config = CommanderConfig { tls: Some(tls), access, ..CommanderConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    let url = commander.url.replace("http://", "https://");
    let ask = async |own: Option<&Signed>, ca: &Signed| {
        let own = own.map(|signed| (signed.certificate.as_path(), signed.key.as_path()));
        let tls = ClientTls::read(&ca.certificate, own.map(|o| o.0), own.map(|o| o.1)).unwrap();
        let channel = endpoint_with(&url, Some(&tls)).unwrap().connect_lazy();
        within(CommanderServiceClient::new(channel).assign(team())).await
    };
    assert_eq!(code(ask(Some(&robot), &authority).await), None);
    assert_eq!(code(ask(Some(&actor), &authority).await), Some(Code::PermissionDenied));
    assert_eq!(code(ask(Some(&unknown), &authority).await), Some(Code::Unauthenticated));
    // These do not get as far as a call.
    for (own, ca) in [(None, &authority), (Some(&stranger), &authority), (Some(&robot), &stranger_ca)] {
        let status = ask(own, ca).await.unwrap_err();
        assert!(!matches!(status.code(), Code::Ok | Code::Unauthenticated | Code::PermissionDenied), "{status}");
    }
    let plain = endpoint_with(&commander.url, None).unwrap().connect_lazy();
    assert!(within(CommanderServiceClient::new(plain).assign(team())).await.is_err());
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn sizes_and_calls_in_flight_are_limited() {
    let limits = Limits { members: 3, ..Limits::default() };
    let config = CommanderConfig { limits, message_bytes: 4096, calls: 1, streams: 1, ..CommanderConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    let mut client = commander_client(&commander.url).await;
    let large = v1::AssignRequest { agents: positions(&[0.0; 8]), ..team() };
    let status = client.assign(large).await.unwrap_err();
    assert!(
        status.code() == Code::InvalidArgument && status.message().contains("4 points are more than 3"),
        "{status}"
    );
    let huge = v1::AssignRequest { agents: positions(&[0.0; 3000]), ..team() };
    let status = client.assign(huge).await.unwrap_err();
    assert!(matches!(status.code(), Code::OutOfRange | Code::ResourceExhausted), "{status}");
    let watch = || v1::WatchAssignmentsRequest::default();
    let mut first = client.watch_assignments(watch()).await.unwrap().into_inner();
    assert!(first.message().await.unwrap().is_some());
    assert_eq!(code(client.watch_assignments(watch()).await), Some(Code::ResourceExhausted));
    drop(first);
    // The place is free again once the service sees that the watcher has gone.
    within(async { while client.watch_assignments(watch()).await.is_err() {} }).await;
    client.assign(team()).await.unwrap();
    commander.stop().await;
}
