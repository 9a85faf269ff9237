use super::*;
use proptest::prelude::*;

fn shards() -> impl Strategy<Value = Shard> {
    (any::<[u32; 5]>(), any::<[bool; 3]>(), 1u32..4).prop_map(|(n, flags, episodes)| Shard {
        kind: if flags[0] { ShardKind::Train } else { ShardKind::Eval },
        iteration: Iteration(n[0]),
        index: n[1],
        episodes,
        first_episode: n[2],
        version: WeightsVersion(n[3]),
        mode: if flags[1] { Mode::Sampled } else { Mode::Greedy },
        eval_set: n[4],
        record: flags[2],
    })
}

fn finite() -> impl Strategy<Value = f32> {
    any::<f32>().prop_filter("equality needs numbers", |x| !x.is_nan())
}

fn floats(count: usize) -> impl Strategy<Value = Vec<f32>> {
    prop::collection::vec(finite(), count)
}

fn metrics(count: usize) -> impl Strategy<Value = Vec<EpisodeMetrics>> {
    // NaN is a metric that the task does not have.
    let one = prop::collection::vec(any::<f32>(), METRICS.len());
    prop::collection::vec(one.prop_map(|values| EpisodeMetrics(values.try_into().unwrap())), count)
}

fn trajectories() -> impl Strategy<Value = Trajectory> {
    (shards(), [1usize..4, 1..4, 0..4, 1..4, 1..3]).prop_flat_map(|(shard, [t, n, extra, d, k])| {
        let b = shard.episodes as usize;
        let (e, h) = (n + extra, k);
        let shape = Shape {
            steps: t,
            episodes: b,
            agents: n,
            bodies: e,
            landmarks: n,
            dims: d,
            agent_state: extra,
            goals_per_agent: k,
            action_components: h,
            world_state: extra,
            moves: extra,
            masks: extra,
            marks: extra.min(1),
        };
        let state = (t + 1) * b * e * d;
        let states = (floats(state), floats(state), floats(b * n * d), floats((t + 1) * b * n * extra));
        let choices =
            (prop::collection::vec(any::<u32>(), b * n * k), prop::collection::vec(any::<u8>(), t * b * n * h));
        let numbers = (floats(t * b * n), floats(t * b * n), floats(b * k), floats(b * k), floats(b * k));
        (states, choices, numbers, metrics(b)).prop_map(move |(states, choices, numbers, metrics)| Trajectory {
            shard,
            shape,
            positions: states.0,
            velocities: states.1,
            statics: Statics::landmarks(n, d, states.2),
            agent_state: states.3,
            goals: choices.0,
            actions: choices.1,
            log_probs: numbers.0,
            rewards: numbers.1,
            moves: (0..t * b * n * extra).map(|x| x as f32 - 0.5).collect(),
            masks: (0..t * b * n * extra).map(|x| (x % 2) as u8).collect(),
            marks: (0..(t + 1) * b * n * extra.min(1)).map(|x| (x % 16) as u8).collect(),
            world_states: (0..(t + 1) * b * extra).map(|x| x as f32).collect(),
            goal_log_probs: numbers.2,
            costs: numbers.3,
            exact_costs: numbers.4,
            metrics,
        })
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn a_shard_round_trips(shard in shards()) {
        prop_assert_eq!(Shard::try_from(&v1::Shard::from(&shard)).unwrap(), shard);
    }

    #[test]
    fn a_trajectory_round_trips(trajectory in trajectories()) {
        let run = RunId("r".into());
        let bytes = encode_result(&run, "abc", &ShardResult::Train(trajectory.clone()));
        let back = decode_result(bytes).unwrap();
        prop_assert_eq!(back.result, ShardResult::Train(trajectory));
        prop_assert_eq!((back.run_id, back.weights_sha256.as_str()), (run, "abc"));
    }

    #[test]
    fn an_evaluation_round_trips(shard in shards(), mut metrics in metrics(3), points in floats(3 * 2 * 2)) {
        metrics.truncate(shard.episodes as usize);
        let shape = Shape { steps: 2, episodes: 1, agents: 2, bodies: 2, landmarks: 2, dims: 2, agent_state: 0, world_state: 0, moves: 0, masks: 0, marks: 0, goals_per_agent: 1, action_components: 1 };
        let recording = Recording { shape, statics: Statics::landmarks(2, 2, points[..4].to_vec()), positions: points, agent_state: vec![], pictures: Vec::new(),
            goals: vec![1, 0] };
        let outcome = ShardResult::Eval(EvalOutcome { shard, metrics, recording: shard.record.then_some(recording) });
        prop_assert_eq!(decode_result(encode_result(&RunId("r".into()), "abc", &outcome)).unwrap().result, outcome);
    }

    #[test]
    fn no_bytes_make_the_decoder_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = decode_result(bytes.into());
    }
}

#[test]
fn metrics_of_another_table_are_named_by_their_path() {
    let shard = v1::Shard { kind: 2, mode: 2, episodes: 2, ..Default::default() };
    let decode = |metrics: Option<v1::Array>| {
        let result = Some(v1::shard_result::Result::Eval(v1::EvalOutcome { metrics, recording: None }));
        decode_result(v1::ShardResult { shard: Some(shard), result, ..Default::default() }.encode_to_vec().into())
            .unwrap_err()
            .to_string()
    };
    assert_eq!(decode(None), "eval.metrics: missing");
    let columns = METRICS.len();
    for [episodes, names] in [[1, columns], [2, columns - 1]] {
        let metrics = arrays::from_f32(&[episodes, names], &vec![0.0; episodes * names]);
        let problem = format!("shape [{episodes}, {names}] where [2, {columns}] is expected");
        assert_eq!(decode(Some(metrics)), format!("eval.metrics: {problem}"));
    }
}

#[test]
fn a_wrong_field_is_named_by_its_path() {
    let shard = v1::Shard { kind: 1, mode: 2, episodes: 1, ..Default::default() };
    let encode = |shard: v1::Shard, body: v1::Trajectory| {
        let result = Some(v1::shard_result::Result::Trajectory(body));
        decode_result(v1::ShardResult { shard: Some(shard), result, ..Default::default() }.encode_to_vec().into())
            .unwrap_err()
            .to_string()
    };
    assert_eq!(encode(shard, v1::Trajectory::default()), "trajectory.shape: missing");
    assert_eq!(encode(v1::Shard { mode: 9, ..shard }, v1::Trajectory::default()), "shard.mode: not set or unknown");
    let shape = v1::Shape {
        steps: 1,
        episodes: 1,
        agents: 1,
        bodies: 1,
        landmarks: 1,
        dims: 2,
        agent_state: 0,
        world_state: 0,
        moves: 0,
        masks: 0,
        marks: 0,
        goals_per_agent: 1,
        action_components: 1,
    };
    let body = v1::Trajectory {
        shape: Some(shape),
        positions: Some(arrays::from_f32(&[2, 1, 1, 3], &[0.0; 6])),
        ..Default::default()
    };
    assert_eq!(encode(shard, body), "trajectory.positions: shape [2, 1, 1, 3] where [2, 1, 1, 2] is expected");
    let huge = v1::Shape { steps: u32::MAX, episodes: u32::MAX, bodies: u32::MAX, dims: u32::MAX, ..shape };
    let body = v1::Trajectory {
        shape: Some(huge),
        positions: Some(v1::Array { r#type: 1, shape: vec![0, u32::MAX, u32::MAX, u32::MAX], data: Bytes::new() }),
        ..Default::default()
    };
    assert!(encode(shard, body).contains("trajectory.positions"));
}
