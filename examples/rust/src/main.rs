//! A client of the goal commander: one assignment, then a mission that is watched while a robot fails.
//!
//! ```sh
//! cargo run --release -- commander &                       # or any running commander
//! cargo run -p magex-example-client -- http://127.0.0.1:7100
//! ```
//!
//! `MAGEX_TOKEN` holds a bearer token if the service wants one. `MAGEX_TLS_CA` names the authority of an https service, and
//! `MAGEX_TLS_CERT` and `MAGEX_TLS_KEY` the client's own certificate and key if it wants one (PEM files).
#![allow(clippy::print_stdout, reason = "an example talks")]

mod connect;

use anyhow::Context as _;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_proto::v1::{
    AssignRequest, Assignment, AssignmentMethod, CreateMissionRequest, DeleteMissionRequest, Member, MemberState,
    Positions, UpdateMissionRequest, WatchAssignmentsRequest, WatchKind,
};
use tonic::metadata::{Ascii, MetadataValue};
use tonic::{Request, Status};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let url = std::env::args().nth(1).unwrap_or_else(|| "http://127.0.0.1:7100".to_owned());
    let channel = connect::to(&url).await?;
    let token = std::env::var("MAGEX_TOKEN").ok().filter(|token| !token.trim().is_empty());
    let bearer: Option<MetadataValue<Ascii>> =
        token.map(|token| format!("Bearer {}", token.trim()).parse()).transpose()?;
    let mut client = CommanderServiceClient::with_interceptor(channel, move |mut request: Request<()>| {
        if let Some(bearer) = &bearer {
            request.metadata_mut().insert("authorization", bearer.clone());
        }
        Ok::<_, Status>(request)
    });

    // Three robots, three charging stations, and a robot that must not use the first one.
    let points =
        |coordinates: &[f64]| Some(Positions { dims: 2, coordinates: coordinates.to_vec(), ..Default::default() });
    let names = |names: [&str; 3]| names.map(str::to_owned).to_vec();
    let request = AssignRequest {
        agents: points(&[0.0, 0.0, 4.0, 0.0, 8.0, 0.0]),
        goals: points(&[0.0, 1.0, 4.0, 1.0, 8.0, 1.0]),
        agent_ids: names(["ada", "bob", "cy"]),
        goal_ids: names(["north", "middle", "south"]),
        scheduler: AssignmentMethod::Exact.into(),
        forbidden: vec![magex_proto::v1::PairRef {
            agent_id: "ada".to_owned(),
            goal_id: "north".to_owned(),
            ..Default::default()
        }],
        ..Default::default()
    };
    let answer = client.assign(request).await?.into_inner();
    for pair in &answer.pairs {
        println!("{} -> {} ({:.2})", pair.agent_id, pair.goal_id, pair.distance);
    }
    println!("total {:.3}, answered by {:?} in {:.3} ms", answer.cost, answer.scheduler(), 1e3 * answer.seconds);

    // A mission: the service remembers the team, and moves a robot to another goal only if that is worth 2 metres.
    let member =
        |id: &str, position: [f64; 2]| Member { id: id.to_owned(), position: position.to_vec(), ..Default::default() };
    let mission = CreateMissionRequest {
        title: "evening charge".to_owned(),
        agents: vec![member("ada", [0.0, 0.0]), member("bob", [4.0, 0.0])],
        goals: vec![member("north", [0.0, 1.0]), member("south", [8.0, 1.0])],
        switching_cost: 2.0,
        ..Default::default()
    };
    let first = client.create_mission(mission).await?.into_inner().assignment.context("no assignment")?;
    let mission_id = first.mission_id.clone();
    let watch = WatchAssignmentsRequest { mission_ids: vec![mission_id.clone()], ..Default::default() };
    let mut changes = client.watch_assignments(watch).await?.into_inner();
    let failed = Member { id: "ada".to_owned(), state: MemberState::Failed.into(), ..Default::default() };
    let update = UpdateMissionRequest { mission_id: mission_id.clone(), agents: vec![failed], ..Default::default() };
    client.update_mission(update).await?;
    while let Some(event) = changes.message().await? {
        match (event.kind(), event.assignment) {
            (WatchKind::Synced, _) => println!("-- watching {mission_id}"),
            (WatchKind::Deleted, _) => break,
            (_, Some(assignment)) => show(&assignment),
            _ => {}
        }
        if event.kind == i32::from(WatchKind::Changed) {
            client.delete_mission(DeleteMissionRequest { mission_id: mission_id.clone() }).await?;
        }
    }
    Ok(())
}

fn show(assignment: &Assignment) {
    println!("revision {} costs {:.3}", assignment.revision, assignment.cost);
    for change in &assignment.changes {
        println!("  {}", change.explanation);
    }
}
