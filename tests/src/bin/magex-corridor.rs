//! An environment as a stranger would write one, for tests: two agents in a corridor, each on the way to its end of it.
//!
//! `magex-corridor [continuous] [masks] [impure] [FAULT FILE]` with FAULT one of raise, nan, hang, shape and exit: it happens in the
//! seventh step of a stream if FILE does not exist, and FILE is made.

#![allow(
    clippy::expect_used,
    clippy::print_stderr,
    reason = "a test's program stops where something is not as it should be"
)]

use magex_proto::arrays;
use magex_proto::v1::EnvironmentProblemKind as Kind;
use magex_proto::v1::environment_description::Action;
use magex_proto::v1::environment_reply::Reply;
use magex_proto::v1::environment_request::Request as Body;
use magex_proto::v1::environment_service_server::{EnvironmentService, EnvironmentServiceServer};
use magex_proto::v1::{
    Array, CheckReply, CheckRequest, ContinuousAction, DescribeRequest, DiscreteAction, EnvironmentDescription,
    EnvironmentProblem, EnvironmentReply, EnvironmentRequest, EnvironmentStep, Observed, Picture,
};
use std::path::PathBuf;
use std::time::Duration;
use tokio::net::UnixListener;
use tokio_stream::wrappers::{ReceiverStream, UnixListenerStream};
use tonic::{Request, Response, Status, Streaming};

const CELLS: i32 = 7;
const AGENTS: usize = 2;
/// Steps after which a world is cut.
const STEPS: u32 = 12;

#[derive(Clone, Default)]
struct Corridor {
    continuous: bool,
    masks: bool,
    impure: bool,
    /// Says that it is pure.
    liar: bool,
    fault: Option<(String, PathBuf)>,
}

/// One world: where its agents are, where they want to go, and which of them are still on the way.
#[derive(Clone)]
struct World {
    at: [i32; AGENTS],
    goal: [i32; AGENTS],
    active: [bool; AGENTS],
    steps: u32,
}

impl World {
    fn new(seed: u32) -> Self {
        // Any function of the seed does.
        let bits = seed.wrapping_mul(2_654_435_761).rotate_left(13);
        let at = [2 + (bits % 3) as i32, 2 + (bits / 3 % 3) as i32];
        let goal = [bits / 16 % 2, bits / 32 % 2].map(|right| if right == 1 { CELLS - 1 } else { 0 });
        Self { at, goal, active: [true; AGENTS], steps: 0 }
    }

    fn over(&self) -> bool {
        self.active == [false; AGENTS]
    }

    fn observation(&self, agent: usize) -> [f32; 3] {
        let place = |cell: i32| cell as f32 / (CELLS - 1) as f32;
        [place(self.at[agent]), place(self.goal[agent]), place(self.at[1 - agent])]
    }
}

/// A step of every world: rewards, ends and cuts, [W, N] each.
#[derive(Default)]
struct Stepped {
    rewards: Vec<f32>,
    terminated: Vec<u8>,
    truncated: Vec<u8>,
    successes: Vec<u8>,
}

impl Corridor {
    fn description(&self) -> EnvironmentDescription {
        let action = match self.continuous {
            true => Action::Continuous(ContinuousAction { low: vec![-1.0], high: vec![1.0] }),
            false => Action::Discrete(DiscreteAction { choices: vec![3] }),
        };
        EnvironmentDescription {
            protocol: 1,
            name: "corridor".into(),
            agents: vec!["left".into(), "right".into()],
            observation_width: 3,
            observation_widths: vec![3, 3],
            action: Some(action),
            state_width: 4,
            masks: self.masks,
            steps_max: STEPS,
            deterministic: !self.impure || self.liar,
            renders: true,
            worlds_max: 0,
            successes: true,
        }
    }

    fn step(&self, worlds: &mut [World], message: &EnvironmentStep) -> Stepped {
        let array = message.actions.clone();
        let shape = [worlds.len(), AGENTS, 1];
        let moves: Vec<i32> = match self.continuous {
            true => {
                let numbers = arrays::to_f32("actions", array, &shape).expect("actions");
                numbers
                    .into_iter()
                    .map(|x| {
                        if x > 0.3 {
                            1
                        } else if x < -0.3 {
                            -1
                        } else {
                            0
                        }
                    })
                    .collect()
            }
            false => {
                arrays::to_u8("actions", array, &shape).expect("actions").iter().map(|c| i32::from(*c) - 1).collect()
            }
        };
        let mut out = Stepped::default();
        for (index, world) in worlds.iter_mut().enumerate() {
            let restart = message.restarts.iter().find(|restart| restart.world as usize == index);
            let (mut rewards, mut terminated, mut truncated) = ([0.0; AGENTS], [0; AGENTS], [0; AGENTS]);
            if let Some(restart) = restart {
                *world = World::new(restart.seed);
            } else if !world.over() {
                world.steps += 1;
                for agent in (0..AGENTS).filter(|&agent| world.active[agent]) {
                    world.at[agent] = (world.at[agent] + moves[index * AGENTS + agent]).clamp(0, CELLS - 1);
                    rewards[agent] = -0.1;
                    if world.at[agent] == world.goal[agent] {
                        (rewards[agent], terminated[agent]) = (1.0, 1);
                    } else if world.steps == STEPS {
                        truncated[agent] = 1;
                    }
                }
                for agent in 0..AGENTS {
                    world.active[agent] &= terminated[agent] + truncated[agent] == 0;
                }
            }
            let success = world.over() && (0..AGENTS).all(|agent| world.at[agent] == world.goal[agent]);
            out.rewards.extend(rewards);
            out.terminated.extend(terminated);
            out.truncated.extend(truncated);
            out.successes.push(u8::from(success));
        }
        out
    }

    fn observed(&self, worlds: &[World], stepped: Stepped) -> Observed {
        let w = worlds.len();
        let noise = if self.impure { std::process::id() as f32 * 1e-6 } else { 0.0 };
        let observations = |world: &World| (0..AGENTS).flat_map(|agent| world.observation(agent)).collect::<Vec<_>>();
        let observations: Vec<f32> = worlds.iter().flat_map(observations).map(|x| x + noise).collect();
        let state = |world: &World| [world.at[0], world.at[1], world.goal[0], world.goal[1]].map(f64::from);
        let states: Vec<f64> = worlds.iter().flat_map(state).collect();
        let allowed = |at: i32| [u8::from(at > 0), 1, u8::from(at < CELLS - 1)];
        let masks: Vec<u8> = worlds.iter().flat_map(|world| world.at).flat_map(allowed).collect();
        let zeros = || vec![0; w * AGENTS];
        let or = |flags: Vec<u8>| if flags.is_empty() { zeros() } else { flags };
        let rewards = if stepped.rewards.is_empty() { vec![0.0; w * AGENTS] } else { stepped.rewards };
        Observed {
            observations: Some(arrays::from_f32(&[w, AGENTS, 3], &observations)),
            rewards: Some(arrays::from_f32(&[w, AGENTS], &rewards)),
            terminated: or(stepped.terminated).into(),
            truncated: or(stepped.truncated).into(),
            active: worlds.iter().flat_map(|world| world.active).map(u8::from).collect::<Vec<u8>>().into(),
            masks: if self.masks { masks.into() } else { Vec::new().into() },
            states: Some(arrays::from_f64(&[w, 4], &states)),
            successes: stepped.successes.into(),
        }
    }

    /// Spoils an answer, once.
    async fn spoil(&self, observed: &mut Observed) -> Option<EnvironmentProblem> {
        let (fault, file) = self.fault.as_ref()?;
        if std::fs::File::create_new(file).is_err() {
            return None;
        }
        match fault.as_str() {
            "raise" => {
                let message = "world 0: ValueError: the floor is lava (corridor.py:7)".into();
                return Some(EnvironmentProblem { kind: Kind::Raised.into(), message, world: Some(0) });
            }
            "nan" => {
                observed.rewards = Some(arrays::from_f32(
                    &[observed.active.len() / AGENTS, AGENTS],
                    &vec![f32::NAN; observed.active.len()],
                ))
            }
            "shape" => observed.observations = Some(Array::default()),
            "hang" => tokio::time::sleep(Duration::from_secs(3600)).await,
            _ => std::process::exit(3),
        }
        None
    }
}

#[tonic::async_trait]
impl EnvironmentService for Corridor {
    async fn describe(&self, _: Request<DescribeRequest>) -> Result<Response<EnvironmentDescription>, Status> {
        Ok(Response::new(self.description()))
    }

    type RunStream = ReceiverStream<Result<EnvironmentReply, Status>>;

    async fn run(&self, requests: Request<Streaming<EnvironmentRequest>>) -> Result<Response<Self::RunStream>, Status> {
        let (sender, replies) = tokio::sync::mpsc::channel(1);
        let (own, mut requests) = (self.clone(), requests.into_inner());
        tokio::spawn(async move {
            let (mut worlds, mut count) = (Vec::<World>::new(), 0);
            while let Ok(Some(message)) = requests.message().await {
                let reply = match message.request {
                    Some(Body::Reset(reset)) => {
                        worlds = reset.seeds.into_iter().map(World::new).collect();
                        Reply::Observed(own.observed(&worlds, Stepped::default()))
                    }
                    Some(Body::Step(step)) => {
                        let stepped = own.step(&mut worlds, &step);
                        let mut observed = own.observed(&worlds, stepped);
                        count += 1;
                        let problem = if count >= 7 { own.spoil(&mut observed).await } else { None };
                        problem.map_or(Reply::Observed(observed), Reply::Problem)
                    }
                    // One white pixel.
                    _ => Reply::Picture(Picture { png: PIXEL.to_vec().into() }),
                };
                if sender.send(Ok(EnvironmentReply { reply: Some(reply) })).await.is_err() {
                    return;
                }
            }
        });
        Ok(Response::new(ReceiverStream::new(replies)))
    }

    async fn check(&self, _: Request<CheckRequest>) -> Result<Response<CheckReply>, Status> {
        Ok(Response::new(CheckReply { deterministic: !self.impure, ..CheckReply::default() }))
    }
}

const PIXEL: &[u8] = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x01\0\0\0\x01\x08\0\0\0\0:~\x9bU\0\0\0\nIDATx\x9cc\xf8\x0f\0\x01\x01\x01\0\x1b\xb6\xeeV\0\0\0\0IEND\xaeB`\x82";

#[tokio::main(flavor = "current_thread")]
async fn main() {
    // The parent holds the other end.
    std::thread::spawn(|| {
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        std::process::exit(0);
    });
    let words: Vec<String> = std::env::args().skip(1).collect();
    let has = |word: &str| words.iter().any(|other| other == word);
    let fault = words.iter().position(|word| ["raise", "nan", "hang", "shape", "exit"].contains(&word.as_str()));
    let fault = fault.and_then(|at| Some((words[at].clone(), PathBuf::from(words.get(at + 1)?))));
    if has("broken") {
        eprintln!("ModuleNotFoundError: No module named 'corridor'");
        std::process::exit(1);
    }
    let corridor = Corridor {
        continuous: has("continuous"),
        masks: has("masks"),
        impure: has("impure"),
        liar: has("liar"),
        fault,
    };
    let socket = std::env::var("MAGEX_ENVIRONMENT_SOCKET").expect("the socket of an actor");
    let incoming = UnixListenerStream::new(UnixListener::bind(socket).expect("a socket"));
    let service = EnvironmentServiceServer::new(corridor);
    tonic::transport::Server::builder().add_service(service).serve_with_incoming(incoming).await.expect("serving");
}
