//! Clients of missions that remember what was acknowledged, and check every answer against it.
//!
//! Each client has a mission of its own, whose revision is the number of changes that were applied and whose content says which one
//! was the last; missions that come and go; and a share in one mission that all of them change. A call without an answer may have
//! had its effect, or have it later.

use magex_core::rng::{Key, Purpose, Stream};
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::client;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use tonic::{Code, Request};

/// The mission that all clients change.
const SHARED: &str = "shared";
/// Missions of a client that come and go, at a time.
const LIVE: usize = 6;

/// What a client saw.
#[derive(Debug, Default)]
pub(crate) struct History {
    /// Calls that were acknowledged, and that had no answer.
    pub(crate) acknowledged: u64,
    pub(crate) unanswered: u64,
    /// Revisions of the shared mission that were acknowledged to this client, in order.
    shared: Vec<u64>,
    shared_unanswered: u64,
    /// Revision and content of its own mission.
    own: (u64, u32),
    /// Changes without an answer: the revision that they expected, and their content.
    pending: Vec<(u64, u32)>,
    live: BTreeSet<String>,
    gone: BTreeSet<String>,
    /// Created or deleted without an answer.
    unknown: BTreeSet<String>,
}

#[derive(Debug)]
pub(crate) struct Client {
    number: u32,
    client: CommanderServiceClient<Channel>,
    stream: Stream,
    history: History,
    names: u32,
}

/// A call's error after which nothing is known of its effect.
fn unanswered(code: Code) -> bool {
    use Code::{Cancelled, DeadlineExceeded, Internal, ResourceExhausted, Unavailable, Unknown};
    [Cancelled, DeadlineExceeded, Internal, ResourceExhausted, Unavailable, Unknown, Code::DataLoss].contains(&code)
}

fn timed<T>(message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.set_timeout(Duration::from_secs(3));
    request
}

fn member(id: &str, content: u32) -> v1::Member {
    v1::Member { id: id.into(), position: vec![if content % 2 == 0 { 1.0 } else { 2.0 }, 0.0], ..Default::default() }
}

/// The content is the name of the goal: any type of positions will do.
fn goal(content: u32) -> v1::Member {
    member(&format!("g{content}"), content)
}

fn content(assignment: &v1::Assignment) -> u32 {
    let last = assignment.goals.iter().filter_map(|goal| goal.id.strip_prefix('g')?.parse().ok()).max();
    last.unwrap_or(0)
}

impl Client {
    /// Its own mission, and the shared one, must be there before anything goes wrong.
    pub(crate) async fn start(url: &str, seed: u64, number: u32) -> Self {
        let channel = client::endpoint(url).unwrap().connect().await.unwrap();
        let stream = Key::new(seed, Purpose::Request, &[number]).stream();
        let client = CommanderServiceClient::new(channel);
        let history = History { own: (1, 0), ..History::default() };
        let mut client = Self { number, client, stream, history, names: 0 };
        client.create(&client.own()).await.unwrap();
        if number == 0 {
            client.create(SHARED).await.unwrap();
        }
        client
    }

    fn own(&self) -> String {
        format!("own-{}", self.number)
    }

    async fn create(&mut self, id: &str) -> Result<(), tonic::Status> {
        let request = v1::CreateMissionRequest {
            mission_id: id.into(),
            agents: vec![member("a", 0)],
            goals: vec![goal(0)],
            ..Default::default()
        };
        self.client.create_mission(timed(request)).await.map(drop)
    }

    /// Calls until the token is cancelled.
    pub(crate) async fn run(mut self, stop: CancellationToken) -> Self {
        while !stop.is_cancelled() {
            match self.stream.below(10) {
                0..=3 => self.update_own().await,
                4 | 5 => self.update_shared().await,
                6 | 7 => self.come().await,
                8 => self.go().await,
                _ => self.look().await,
            }
            tokio::time::sleep(Duration::from_millis(u64::from(self.stream.below(40)))).await;
        }
        self
    }

    async fn update_own(&mut self) {
        let (revision, before) = self.history.own;
        self.names += 1;
        let now = self.names;
        let request = v1::UpdateMissionRequest {
            mission_id: self.own(),
            expected_revision: Some(revision),
            goals: vec![goal(now)],
            remove_goals: if before == 0 { Vec::new() } else { vec![format!("g{before}")] },
            ..Default::default()
        };
        match self.client.update_mission(timed(request)).await {
            Ok(answer) => {
                let found = answer.into_inner().assignment.unwrap();
                assert_eq!((found.revision, content(&found)), (revision + 1, now), "client {}", self.number);
                self.history.own = (revision + 1, now);
                self.history.acknowledged += 1;
            }
            // One without an answer may have come through meanwhile.
            Err(status) if unanswered(status.code()) || status.code() == Code::Aborted => {
                self.history.unanswered += 1;
                self.history.pending.push((revision, now));
                self.resolve().await;
            }
            Err(status) => panic!("client {}: {status}", self.number),
        }
    }

    /// Reads its own mission until there is an answer: it stands where it stood, or one further by a change that was asked for.
    async fn resolve(&mut self) {
        let request = v1::GetAssignmentRequest { mission_id: self.own() };
        match self.client.get_assignment(timed(request)).await {
            Ok(answer) => self.accept(&answer.into_inner().assignment.unwrap()),
            Err(status) if unanswered(status.code()) => {}
            Err(status) => panic!("client {}: its mission is lost: {status}", self.number),
        }
    }

    fn accept(&mut self, found: &v1::Assignment) {
        let (revision, before) = self.history.own;
        let (now, what) = (found.revision, content(found));
        let came_through = now == revision + 1 && self.history.pending.contains(&(revision, what));
        assert!(
            (now, what) == (revision, before) || came_through,
            "client {}: revision {now} with {what} after {revision} with {before}; unanswered: {:?}",
            self.number,
            self.history.pending
        );
        self.history.own = (now, what);
        self.history.pending.retain(|(expected, _)| *expected >= now);
    }

    async fn update_shared(&mut self) {
        let request = v1::UpdateMissionRequest { mission_id: SHARED.into(), ..Default::default() };
        match self.client.update_mission(timed(request)).await {
            Ok(answer) => {
                let revision = answer.into_inner().assignment.unwrap().revision;
                assert!(self.history.shared.last().is_none_or(|last| *last < revision), "time runs backwards");
                self.history.shared.push(revision);
                self.history.acknowledged += 1;
            }
            Err(status) if unanswered(status.code()) || status.code() == Code::Aborted => {
                self.history.unanswered += 1;
                self.history.shared_unanswered += 1;
            }
            Err(status) => panic!("client {}: {status}", self.number),
        }
    }

    async fn come(&mut self) {
        if self.history.live.len() >= LIVE {
            return self.go().await;
        }
        self.names += 1;
        let name = format!("m-{}-{}", self.number, self.names);
        match self.create(&name).await {
            Ok(()) => drop(self.history.live.insert(name)),
            Err(status) if unanswered(status.code()) => {
                self.history.unanswered += 1;
                self.history.unknown.insert(name);
                return;
            }
            Err(status) => panic!("client {}: {status}", self.number),
        }
        self.history.acknowledged += 1;
    }

    async fn go(&mut self) {
        // What may be there is deleted too, so that it does not fill the service.
        let one = self.history.unknown.first().or(self.history.live.first()).cloned();
        let Some(name) = one else { return };
        let sure = !self.history.unknown.contains(&name);
        match self.client.delete_mission(timed(v1::DeleteMissionRequest { mission_id: name.clone() })).await {
            Ok(_) => {
                self.history.live.remove(&name);
                self.history.acknowledged += 1;
                // A creation without an answer may come through after it.
                if sure {
                    self.history.gone.insert(name);
                } else {
                    self.history.unknown.remove(&name);
                }
            }
            Err(status) if status.code() == Code::NotFound && !sure => drop(self.history.unknown.remove(&name)),
            Err(status) if unanswered(status.code()) => {
                self.history.unanswered += 1;
                self.history.live.remove(&name);
                self.history.unknown.insert(name);
            }
            Err(status) => panic!("client {}: {name}: {status}", self.number),
        }
    }

    async fn look(&mut self) {
        let places = [self.history.live.first(), self.history.gone.last()];
        for (name, there) in
            places.into_iter().zip([true, false]).filter_map(|(name, there)| Some((name?.clone(), there)))
        {
            match self.client.get_assignment(timed(v1::GetAssignmentRequest { mission_id: name.clone() })).await {
                Ok(_) => assert!(there, "{name} was deleted, and is there"),
                Err(status) if status.code() == Code::NotFound => assert!(!there, "{name} was created, and is lost"),
                Err(status) if unanswered(status.code()) => {}
                Err(status) => panic!("{status}"),
            }
        }
    }
}

/// At the end, in peace: all that was acknowledged is there, and nothing else. Returns acknowledged and unanswered calls.
pub(crate) async fn check(clients: Vec<Client>, url: &str) -> (u64, u64) {
    let mut client = CommanderServiceClient::new(client::endpoint(url).unwrap().connect().await.unwrap());
    let request =
        v1::ListAssignmentsRequest { page_size: 500, source: v1::MissionSource::Client.into(), ..Default::default() };
    let all = client.list_assignments(request).await.unwrap().into_inner().assignments;
    let mut found: BTreeMap<String, v1::Assignment> = all.into_iter().map(|a| (a.mission_id.clone(), a)).collect();
    let (mut acknowledged, mut unanswered, mut revisions, mut maybe) = (0, 0, BTreeSet::new(), 0);
    for mut client in clients {
        let own = found.remove(&client.own()).unwrap_or_else(|| panic!("{} is lost", client.own()));
        client.accept(&own);
        for name in &client.history.live {
            assert!(found.remove(name).is_some(), "{name} was acknowledged, and is lost");
        }
        let back = client.history.gone.iter().find(|name| found.contains_key(*name));
        assert_eq!(back, None, "deleted, and there again");
        client.history.unknown.iter().for_each(|name| drop(found.remove(name)));
        for revision in &client.history.shared {
            assert!(revisions.insert(*revision), "revision {revision} was acknowledged twice");
        }
        maybe += client.history.shared_unanswered;
        acknowledged += client.history.acknowledged;
        unanswered += client.history.unanswered;
    }
    let shared = found.remove(SHARED).unwrap();
    let (least, most) = (1 + revisions.len() as u64, 1 + revisions.len() as u64 + maybe);
    assert!((least..=most).contains(&shared.revision), "revision {} of {least} to {most}", shared.revision);
    assert!(revisions.last().is_none_or(|last| *last <= shared.revision));
    // A creation whose deletion was answered first may have come through later.
    let strangers: Vec<&String> = found.keys().filter(|name| !name.starts_with("m-")).collect();
    assert!(strangers.is_empty(), "no client made {strangers:?}");
    (acknowledged, unanswered)
}
