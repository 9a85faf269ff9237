//! Untrusted bytes: a fixed number of damaged copies of good examples goes through every decoder.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_commander::run_scheduler::load_scheduler;
use magex_commander::service::ServiceConfig;
use magex_core::ids::{Iteration, Mode, RunId, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::{METRICS, REWARD};
use magex_core::statics::Statics;
use magex_core::trajectory::{EpisodeMetrics, ShardResult, Trajectory};
use magex_proto::convert::encode_result;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_proto::weights::Weights;
use magex_proto::{parts, v1};
use magex_runtime::{client, server};
use magex_tests::decoders::files::Run;
use magex_tests::decoders::mutate::Mutations;
use magex_tests::decoders::{dispatch, wire};
use magex_tests::raw::Raw;
use prost::Message as _;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::{Code, Request};
use tonic_types::StatusExt as _;

/// Runs a target on examples and on `count` damaged copies. `MAGEX_SEEDS` names a folder that the examples are written to: seeds
/// for fuzz/run.
fn run(name: &str, examples: Vec<Vec<u8>>, count: usize, target: impl Fn(&[u8])) {
    for (k, example) in examples.iter().enumerate() {
        target(example);
        if let Some(seeds) = std::env::var_os("MAGEX_SEEDS") {
            let folder = std::path::Path::new(&seeds).join(name);
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join(format!("example-{k}")), example).unwrap();
        }
    }
    let mut mutations = Mutations::new(examples, 11);
    for _ in 0..count {
        target(&mutations.draw());
    }
}

fn team() -> v1::AssignRequest {
    let points =
        |coordinates: &[f64]| Some(v1::Positions { dims: 2, coordinates: coordinates.to_vec(), ..Default::default() });
    let pair =
        |agent: &str, goal: &str| v1::PairRef { agent_id: agent.into(), goal_id: goal.into(), ..Default::default() };
    v1::AssignRequest {
        agents: points(&[0.0, 0.0, 4.0, 0.0, 8.0, 1.0]),
        goals: points(&[0.0, 1.0, 4.0, 1.0, 8.0, 2.0]),
        agent_ids: ["a", "b", "c"].map(str::to_owned).to_vec(),
        goal_ids: ["x", "y", "z"].map(str::to_owned).to_vec(),
        scheduler: v1::AssignmentMethod::Exact.into(),
        forbidden: vec![pair("a", "x")],
        cost_overrides: vec![v1::PairCost { pair: Some(pair("b", "y")), cost: 0.5 }],
        current: vec![pair("c", "y")],
        switching_cost: 0.25,
        seed: Some(3),
        ..Default::default()
    }
}

fn requests() -> Vec<Vec<u8>> {
    let kinds = [
        v1::AssignmentMethod::Exact,
        v1::AssignmentMethod::Makespan,
        v1::AssignmentMethod::Greedy,
        v1::AssignmentMethod::Random,
    ];
    let mut examples: Vec<_> =
        kinds.map(|kind| v1::AssignRequest { scheduler: kind.into(), ..team() }.encode_to_vec()).to_vec();
    let costs = Some(v1::CostMatrix { agents: 2, goals: 3, values: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0] });
    examples.push(v1::AssignRequest { costs, ..Default::default() }.encode_to_vec());
    examples.push(worded().encode_to_vec());
    let sparse = v1::SparseCosts {
        agents: 3,
        goals: 2,
        agent_indices: vec![0, 1, 2],
        goal_indices: vec![0, 1, 1],
        values: vec![1.0, 2.0, f64::INFINITY],
    };
    examples.push(v1::AssignRequest { sparse_costs: Some(sparse), ..Default::default() }.encode_to_vec());
    examples
}

/// A team that says every word.
fn worded() -> v1::AssignRequest {
    v1::AssignRequest {
        power: Some(2.0),
        agent_speeds: vec![1.0, 2.0, 0.5],
        agent_offsets: vec![0.0, 3.0, 1.0],
        agent_loads: vec![1.0, 0.0, 2.0],
        balance: 0.5,
        goal_weights: vec![1.0, 2.0, 3.0],
        goal_capacities: vec![2, 1, 1],
        goal_earliest: vec![0.0, 4.0, 0.0],
        goal_due: vec![f64::INFINITY, 40.0, 9.0],
        precedence: vec![v1::Precedence { goal_id: "z".into(), after_id: "x".into(), ..Default::default() }],
        pinned: vec![v1::PairRef { agent_id: "c".into(), goal_id: "y".into(), ..Default::default() }],
        ..team()
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

fn update() -> v1::UpdateMissionRequest {
    let forbid = vec![v1::PairRef { agent_id: "a".into(), goal_id: "x".into(), ..Default::default() }];
    let agents = vec![member("c", 2.0), v1::Member { state: v1::MemberState::Failed.into(), ..member("b", 0.0) }];
    v1::UpdateMissionRequest { mission_id: "yard".into(), agents, forbid, ..Default::default() }
}

fn framed<const BYTES: usize>(messages: &[Vec<u8>]) -> Vec<u8> {
    messages.iter().flat_map(|m| m.len().to_le_bytes()[..BYTES].iter().chain(m).copied().collect::<Vec<u8>>()).collect()
}

#[test]
fn requests_missions_and_their_records() {
    run("assign", requests(), 200_000, dispatch::assign);
    let life = framed::<1>(&[mission().encode_to_vec(), update().encode_to_vec(), update().encode_to_vec()]);
    let pair =
        |agent: &str, goal: &str| v1::PairRef { agent_id: agent.into(), goal_id: goal.into(), ..Default::default() };
    let worded = v1::CreateMissionRequest {
        power: Some(1.5),
        balance: 1.0,
        time: 5.0,
        pinned: vec![pair("a", "x")],
        agents: vec![
            v1::Member { speed: Some(2.0), busy_until: Some(9.0), load: Some(1.0), ..member("a", 0.0) },
            member("b", 4.0),
        ],
        goals: vec![
            v1::Member {
                weight: Some(2.0),
                capacity: Some(2),
                earliest: Some(6.0),
                due: Some(70.0),
                ..member("x", 1.0)
            },
            v1::Member { after: Some(v1::GoalNames { goal_ids: vec!["x".into()] }), ..member("y", 5.0) },
        ],
        ..mission()
    };
    let later = v1::UpdateMissionRequest {
        time: Some(8.0),
        power: Some(2.0),
        unpin: vec![pair("a", "x")],
        pin: vec![pair("b", "x")],
        forfeit: vec!["a".into()],
        ..update()
    };
    let words = framed::<1>(&[worded.encode_to_vec(), later.encode_to_vec(), update().encode_to_vec()]);
    run("mission", vec![life, words], 100_000, dispatch::mission);
    let limits = magex_dispatch::mission::MissionLimits { members: 16, lifetime_ms: 1000 };
    let planner = |problem: &magex_dispatch::Problem| {
        let plan = magex_dispatch::engine::solve(problem, problem.scheduler, &|| true)?;
        Ok(magex_dispatch::answer::Planned { plan, fallback_reason: String::new(), weights: None })
    };
    let kept = magex_dispatch::mission::Mission::create(mission(), "me", "", 0, &limits, &planner).unwrap();
    run("record", vec![kept.encode()], 100_000, dispatch::record);
}

fn trajectory(run: &Run) -> ShardResult {
    let task = &run.config().task;
    let shard = Shard {
        kind: ShardKind::Train,
        iteration: Iteration(0),
        index: 0,
        episodes: 2,
        first_episode: 0,
        version: WeightsVersion(0),
        mode: Mode::Sampled,
        eval_set: 0,
        record: false,
    };
    let shape = task.shape(2);
    let (t, b, n) = (shape.steps, shape.episodes, shape.agents);
    // A value that every metric may have. All agents are at one place, so every assignment is exact.
    let mut metrics = EpisodeMetrics([1.0; METRICS.len()]);
    metrics[REWARD] = 0.3;
    let in_order: Vec<u32> = (0..n as u32).collect();
    let cost = magex_assign::cost_of_points(&vec![0.5; 2 * n], &vec![0.1; 2 * n], 2, &in_order) as f32;
    ShardResult::Train(Trajectory {
        shard,
        shape,
        positions: vec![0.5; (t + 1) * b * n * 2],
        velocities: vec![0.25; (t + 1) * b * n * 2],
        agent_state: vec![],
        statics: Statics::landmarks(n, 2, vec![0.1; b * n * 2]),
        goals: (0..b * n).map(|i| (i % n) as u32).collect(),
        actions: vec![1; t * b * n],
        log_probs: vec![-1.0; t * b * n],
        rewards: vec![0.3; t * b * n],
        moves: Vec::new(),
        masks: Vec::new(),
        marks: Vec::new(),
        world_states: Vec::new(),
        goal_log_probs: vec![-1.0; b],
        costs: vec![cost; b],
        exact_costs: vec![cost; b],
        metrics: vec![metrics; b],
    })
}

#[test]
fn trajectories_parts_and_weights() {
    let damaged = Run::default();
    let good = encode_result(&RunId("r".into()), "sha", &trajectory(&damaged));
    run("result", vec![good.to_vec()], 100_000, wire::result);
    run("admission", vec![good.to_vec()], 100_000, |bytes| damaged.admit(bytes));
    let part = |data: &[u8], index, total, total_bytes| {
        let crc32c = parts::split(data.to_vec().into()).next().unwrap().crc32c;
        v1::Part { index, total, total_bytes, crc32c, data: data.to_vec().into() }.encode_to_vec()
    };
    let whole = framed::<2>(&[part(b"one ", 0, 2, 7), part(b"two", 1, 2, 7), part(b"all", 0, 1, 3)]);
    run("parts", vec![[vec![0], whole.clone()].concat(), [vec![1], whole].concat()], 200_000, wire::parts);
    let weights = Weights::new(RunId("r".into()), WeightsVersion(1), b"weights"[..].into());
    let stream: Vec<_> = weights.messages("name = 'x'").map(|message| message.encode_to_vec()).collect();
    let stream = framed::<2>(&[stream.clone(), stream].concat());
    run("weights", vec![[vec![0], stream.clone()].concat(), [vec![1], stream].concat()], 100_000, wire::weights);
    let batch = v1::AssignBatchRequest::default().encode_to_vec();
    run("goals", vec![batch, good.slice(..200).to_vec()], 50_000, wire::goals);
}

#[test]
fn weights_files_and_checkpoints() {
    let damaged = Run::default();
    // Most of a weights file is numbers; the head is what can be wrong.
    let good = damaged.good_weights();
    load_scheduler(&good, &damaged.config().to_toml().unwrap()).unwrap();
    run("weights-file", vec![good.clone(), good[..2048.min(good.len())].to_vec()], 15_000, |bytes| {
        damaged.weights(bytes)
    });
    run("checkpoint", damaged.good_files(), 6_000, |bytes| damaged.checkpoint(bytes));
}

/// Whatever comes in over the wire, the service answers with sense, in time, and goes on.
#[tokio::test(flavor = "multi_thread")]
async fn the_whole_commander() {
    let (incoming, address) = server::bind("127.0.0.1:0").await.unwrap();
    let stop = CancellationToken::new();
    let serving =
        tokio::spawn(magex_commander::service::run(ServiceConfig::default(), load_scheduler, incoming, stop.clone()));
    let channel = client::endpoint(&format!("http://{address}")).unwrap().connect().await.unwrap();
    let many = v1::AssignManyRequest { teams: vec![team(), team()] }.encode_to_vec();
    let mut calls = [
        ("Assign", Mutations::new(requests(), 1)),
        ("AssignMany", Mutations::new(vec![many], 2)),
        ("CreateMission", Mutations::new(vec![mission().encode_to_vec()], 3)),
        ("UpdateMission", Mutations::new(vec![update().encode_to_vec()], 4)),
        (
            "GetAssignment",
            Mutations::new(vec![v1::GetAssignmentRequest { mission_id: "yard".into() }.encode_to_vec()], 5),
        ),
        (
            "ListAssignments",
            Mutations::new(vec![v1::ListAssignmentsRequest { page_size: 2, ..Default::default() }.encode_to_vec()], 6),
        ),
        (
            "DeleteMission",
            Mutations::new(vec![v1::DeleteMissionRequest { mission_id: "yard".into() }.encode_to_vec()], 7),
        ),
        ("AssignBatch", Mutations::new(vec![v1::AssignBatchRequest::default().encode_to_vec()], 8)),
    ];
    let mut raw = tonic::client::Grpc::new(channel.clone());
    let mut answered = 0;
    for _ in 0..8_000 {
        for (method, mutations) in &mut calls {
            let bytes = mutations.draw();
            raw.ready().await.unwrap();
            let path = PathAndQuery::try_from(format!("/magex.v1.CommanderService/{method}")).unwrap();
            let call = raw.unary(Request::new(bytes.clone().into()), path, Raw);
            match tokio::time::timeout(Duration::from_secs(60), call).await.unwrap() {
                Ok(answer) => {
                    answered += 1;
                    if let ("Assign", Ok(request)) = (*method, v1::AssignRequest::decode(&bytes[..])) {
                        let response = v1::AssignResponse::decode(&answer.into_inner()[..]).unwrap();
                        let problem =
                            magex_dispatch::Problem::read(request, 1, &magex_dispatch::Limits::default()).unwrap();
                        dispatch::check_matching(
                            &response,
                            problem.agent_count,
                            &problem.terms.capacities,
                            problem.goal_count,
                        );
                    }
                }
                Err(status) => match status.code() {
                    Code::InvalidArgument => {
                        let fields = status.get_details_bad_request().unwrap().field_violations;
                        assert!(!fields[0].field.is_empty(), "{method}: {status}");
                    }
                    Code::Internal => assert!(status.message().contains("decode"), "{method}: {status}"),
                    // A deadline that damage made too short, missions that are many, there, or not.
                    Code::DeadlineExceeded
                    | Code::ResourceExhausted
                    | Code::NotFound
                    | Code::AlreadyExists
                    | Code::Aborted
                    | Code::FailedPrecondition => {}
                    code => panic!("{method}: {code}: {status}"),
                },
            }
        }
    }
    assert!(answered > 1_000, "only {answered} calls got past the checks: the copies are too damaged to tell anything");
    CommanderServiceClient::new(channel).assign(team()).await.unwrap();
    stop.cancel();
    serving.await.unwrap().unwrap();
}
