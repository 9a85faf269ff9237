//! The commander as a process: what survives a kill, how it ends, and what it refuses to be.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tonic::transport::Channel;

struct Service {
    child: Child,
    url: String,
}

impl Service {
    fn command(arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_magex"));
        command.arg("commander").args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn start(data: &Path) -> Self {
        let data = data.display().to_string();
        let mut child = Self::command(&["--listen", "127.0.0.1:0", "--data", &data]).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let ready: serde_json::Value = serde_json::from_str(&line).unwrap();
        Self { url: format!("http://{}", ready["address"].as_str().unwrap()), child }
    }

    async fn client(&self) -> CommanderServiceClient<Channel> {
        CommanderServiceClient::new(magex_runtime::client::endpoint(&self.url).unwrap().connect().await.unwrap())
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn member(id: &str, x: f64) -> v1::Member {
    v1::Member { id: id.into(), position: vec![x, 0.0], ..Default::default() }
}

fn mission() -> v1::CreateMissionRequest {
    v1::CreateMissionRequest {
        mission_id: "yard".into(),
        agents: vec![member("a", 0.0), member("b", 4.0)],
        goals: vec![member("x", 1.0), member("y", 5.0)],
        switching_cost: 1.0,
        ..Default::default()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn missions_survive_a_kill_and_the_data_folder_has_one_owner() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = Service::start(folder.path());
    let mut client = service.client().await;
    client.create_mission(mission()).await.unwrap();
    let update =
        v1::UpdateMissionRequest { mission_id: "yard".into(), agents: vec![member("a", 3.0)], ..Default::default() };
    let last = client.update_mission(update).await.unwrap().into_inner().assignment.unwrap();
    let data = folder.path().display().to_string();
    let second = Service::command(&["--listen", "127.0.0.1:0", "--data", &data]).output().unwrap();
    let told = String::from_utf8_lossy(&second.stderr).into_owned();
    assert!(second.status.code() == Some(73) && told.contains("another commander uses it"), "{told}");
    service.child.kill().unwrap();
    service.child.wait().unwrap();
    let service = Service::start(folder.path());
    let request = v1::GetAssignmentRequest { mission_id: "yard".into() };
    let found = service.client().await.get_assignment(request).await.unwrap().into_inner().assignment.unwrap();
    assert_eq!(found, last);
}

#[tokio::test(flavor = "multi_thread")]
async fn it_ends_in_time_with_a_watcher_and_an_idle_socket() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = Service::start(folder.path());
    let mut client = service.client().await;
    let mut watch = client.watch_assignments(v1::WatchAssignmentsRequest::default()).await.unwrap().into_inner();
    assert_eq!(watch.message().await.unwrap().unwrap().kind(), v1::WatchKind::Synced);
    let _idle = tokio::net::TcpStream::connect(service.url.trim_start_matches("http://")).await.unwrap();
    let start = Instant::now();
    assert!(Command::new("kill").arg(service.child.id().to_string()).status().unwrap().success());
    let status = watch.message().await.unwrap_err();
    assert_eq!((status.code(), status.message()), (tonic::Code::Unavailable, "the service is stopping"));
    let end = loop {
        if let Some(status) = service.child.try_wait().unwrap() {
            break status;
        }
        assert!(start.elapsed() < Duration::from_secs(60));
        tokio::time::sleep(Duration::from_millis(10)).await;
    };
    let mut told = String::new();
    service.child.stderr.take().unwrap().read_to_string(&mut told).unwrap();
    assert!(end.success() && start.elapsed() < Duration::from_secs(10), "{:?}: {told}", start.elapsed());
}

#[test]
fn it_does_not_open_itself_to_others_by_accident() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |arguments: &[&str], words: &[&str]| {
        let output = Service::command(arguments).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(64), "{told}");
        for word in words {
            assert!(told.contains(word), "{word}: {told}");
        }
    };
    refused(&["--listen", "0.0.0.0:0"], &["--tls-cert and --tls-key, and --identities", "--insecure"]);
    let identities = folder.path().join("clients.toml");
    let hash = "ab".repeat(32);
    std::fs::write(&identities, format!("[[identity]]\nname = 'a'\nrole = 'client'\ntoken_sha256 = '{hash}'")).unwrap();
    let clients = identities.display().to_string();
    refused(&["--listen", "0.0.0.0:0", "--identities", &clients], &["add --tls-cert and --tls-key, or --insecure"]);
    refused(&["--identities", "nowhere.toml"], &["nowhere.toml"]);
    refused(&["--tls-cert", "a.pem"], &["--tls-key"]);
    refused(&["--weights", "nowhere"], &["nowhere"]);
    refused(&["--max-agents", "0"], &["--max-agents"]);
}
