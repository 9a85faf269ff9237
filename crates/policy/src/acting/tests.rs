use super::*;
use magex_core::config::{ExecutorKind, Observes};
use magex_core::task::{Spawn, TaskName};
use magex_nets::params::{Params, to_safetensors};

/// A run's configuration and its weights as they begin.
fn fresh(name: TaskName, kind: ExecutorKind, agents: usize) -> (RunConfig, Vec<u8>) {
    let mut config = RunConfig { task: TaskConfig::of(name, agents, Spawn::Uniform), ..RunConfig::default() };
    config.executor.kind = kind;
    if kind.flat() {
        config.executor.observes = Observes::Goals;
    }
    let config = config.validated().unwrap();
    let model = Model::new(&config).unwrap();
    let drawn: Vec<Params> = (0..)
        .zip(model.layouts().unwrap())
        .map(|(part, layout)| Params::init(layout, Key::new(7, Purpose::Init, &[part]).stream()))
        .collect();
    let named: Vec<(&str, &Params)> = model.parts().iter().map(|part| part.name).zip(&drawn).collect();
    let weights = to_safetensors(&named, "").unwrap();
    (config, weights)
}

fn teams(task: &TaskConfig, b: usize, n: usize) -> Teams {
    let mut stream = Key::new(3, Purpose::Bench, &[]).stream();
    let mut draw = |count: usize| -> Vec<f32> { (0..count).map(|_| stream.range(-1.0, 1.0) as f32).collect() };
    let (d, balls) = (task.dims(), if task.balls() > 0 { b * n * task.dims() } else { 0 });
    Teams {
        teams: b,
        dims: d,
        side: None,
        positions: draw(b * n * d),
        velocities: draw(b * n * d),
        goals: draw(b * n * d),
        balls: draw(balls),
        ball_velocities: draw(balls),
        agent_state: vec![0.0; b * n * task.agent_state()],
    }
}

#[test]
fn teams_side_by_side_act_as_each_alone_and_their_memory_goes_on() {
    for (name, kind) in [
        (TaskName::SimpleSpread, ExecutorKind::Magex),
        (TaskName::PushBall, ExecutorKind::Magex),
        (TaskName::PushBall, ExecutorKind::Local),
        (TaskName::Drones, ExecutorKind::Attention),
    ] {
        let (config, weights) = fresh(name, kind, 4);
        let policies = Policies::load(&config, &weights).unwrap();
        let both = teams(&config.task, 2, 6);
        let first = policies.act(&both, None, Choice::GREEDY).unwrap();
        let next = policies.act(&both, Some(first.memory.clone()), Choice::GREEDY).unwrap();
        assert_eq!(first.logits != next.logits, policies.of_size(6, None).unwrap().memory() > 0);
        let half = |values: &[f32]| values[values.len() / 2..].to_vec();
        let second = Teams {
            teams: 1,
            positions: half(&both.positions),
            velocities: half(&both.velocities),
            goals: half(&both.goals),
            balls: half(&both.balls),
            ball_velocities: half(&both.ball_velocities),
            agent_state: half(&both.agent_state),
            ..both.clone()
        };
        let alone = policies.act(&second, Some(half(&first.memory)), Choice::GREEDY).unwrap();
        assert_eq!(alone.logits, half(&next.logits));
        for (row, action) in next.logits.chunks(5).zip(&next.actions).filter(|_| name != TaskName::Drones) {
            let best = row.iter().copied().fold(f32::MIN, f32::max);
            assert_eq!(row[usize::from(*action)], best, "the action is the best choice along the axes of the world");
        }
        let sum: f32 = next.probabilities[..if name == TaskName::Drones { 3 } else { 5 }].iter().sum();
        assert!((sum - 1.0).abs() < 1e-5);
        let sampled = |seed| policies.act(&both, None, Choice { mode: Mode::Sampled, seed }).unwrap();
        assert_eq!(sampled(1), sampled(1));
        assert_ne!(sampled(1).actions, sampled(2).actions);
    }
}

#[test]
fn wrong_fields_are_named() {
    let (config, weights) = fresh(TaskName::SimpleSpread, ExecutorKind::Magex, 4);
    let policies = Policies::load(&config, &weights).unwrap();
    let refused = |change: fn(&mut Teams), words: &str| {
        let mut teams = teams(&config.task, 2, 5);
        change(&mut teams);
        let error = policies.act(&teams, None, Choice::GREEDY).unwrap_err().to_string();
        assert!(error.starts_with(words), "{error}");
    };
    refused(|t| t.dims = 3, "dims: 3; simple-spread has 2");
    refused(|t| t.positions.truncate(19), "positions: 19 numbers");
    refused(|t| t.positions.clear(), "positions: 0 numbers");
    refused(|t| t.goals.truncate(10), "goals: 10 numbers; 2 teams of 5 agents need 20");
    refused(|t| t.velocities[7] = f32::NAN, "velocities[7]: NaN");
    refused(|t| t.velocities[7] = 1e20, "velocities[7]: 1");
    refused(|t| t.balls = vec![0.0; 20], "balls: 20 numbers; simple-spread has none");
    refused(|t| t.side = Some(0.0), "side: 0");
    let teams = teams(&config.task, 1, 5);
    assert!(policies.act(&teams, Some(vec![0.0; 7]), Choice::GREEDY).unwrap_err().to_string().starts_with("memory: 7"));
    let (config, weights) = fresh(TaskName::SimpleSpread, ExecutorKind::Flat, 4);
    let error = Policies::load(&config, &weights).unwrap().act(&teams, None, Choice::GREEDY).unwrap_err();
    assert_eq!(error.to_string(), "positions: 5 agents; the flat executor of this run was built for 4");
}
