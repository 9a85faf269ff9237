use super::raw::RENAMED;
use super::*;
use crate::task::TaskName;

#[test]
fn an_empty_file_is_the_first_run_and_one_without_a_task_changes_it() {
    let config = RunConfig::from_toml("").unwrap();
    assert_eq!(config, RunConfig::default());
    assert_eq!(RunConfig::from_toml(&config.to_toml().unwrap()).unwrap(), config);
    let written_out = include_str!("../../../../deploy/configs/spread-50.toml");
    assert_eq!(RunConfig::from_toml(written_out).unwrap(), config);
    let changed = RunConfig::from_toml("[run]\nseed = 7\n[collect]\nshards_per_iteration = 6").unwrap();
    let mut expected = config;
    (expected.run.seed, expected.collect) = (7, CollectConfig { episodes_per_iteration: 6, shards_per_iteration: 6 });
    assert_eq!(changed, expected);
    let other = RunConfig::from_toml(
        "[run]\nalgorithm = 'qmix'\n[task]\nname = 'simple-spread'\nagents = 50\nspawn = 'lines'\n\
                                      reward_target = 'team'\n[executor]\nkind = 'flat'\nrecurrent = true",
    );
    assert!(other.is_ok(), "{other:?}");
    let error = RunConfig::from_toml("[run]\nalgorithm = 'qmix'").unwrap_err().to_string();
    assert!(!error.contains("mappo."), "keys that the file does not set are not at fault: {error}");
    // With a task, the documented defaults.
    let other = RunConfig::from_toml("[task]\nname = 'simple-spread'\nagents = 50\nspawn = 'lines'").unwrap();
    assert_eq!((other.run, other.mappo), (RunSection::default(), MappoConfig::default()));
    let error = |text| RunConfig::from_toml(text).unwrap_err().to_string();
    assert!(error("[mappo]\nalpha = 1").contains("mappo.alpha"));
    assert!(error("run = 3").contains("run"));
}

#[test]
fn the_weights_that_a_run_begins_from_are_a_hash() {
    let text = |hash: &str| format!("[run]\ninitial_weights = '{hash}'");
    assert!(RunConfig::from_toml(&text(&"0a".repeat(32))).is_ok());
    for wrong in ["0a", &"0g".repeat(32)] {
        let error = RunConfig::from_toml(&text(wrong)).unwrap_err().to_string();
        assert!(error.contains("run.initial_weights") && error.contains("SHA-256"), "{error}");
    }
}

#[test]
fn unknown_keys_and_bad_values_are_named() {
    for (text, name) in [
        ("[mappo]\ngama = 0.9", "mappo.gama: unknown key; use gamma"),
        ("[executer]\nkind = 'local'", "executer: unknown key"),
        ("[mappo]\ngamma = 'a'", "mappo.gamma: \"a\" is a text; write a number from 0 to 1"),
        ("[task]\nname = 'drones'\nagents = 2\nspawn = 'uniform'\ndrones.crsh = 1", "task.drones.crsh: unknown key"),
        ("[task]\nname = 'drones'\nagents = 2\nspawn = 'uniform'\nsides = 1", "task.sides: unknown key"),
        ("[collect]\nepisodes_per_iteration = 0", "leave it out for the default"),
        ("run = 1", "run: 1 is not a section"),
        ("[mappo", "line 1 (`[mappo`)"),
        ("[mappo]\ngamma = 1.5", "mappo.gamma"),
        ("[collect]\nepisodes_per_iteration = 9\nshards_per_iteration = 4", "collect.shards_per_iteration"),
        ("[mappo]\nchunk_length = 7", "mappo.chunk_length"),
        ("[executor]\nfeature_size = 20", "executor.feature_size"),
        ("[run]\nmax_steps = 0", "run.max_steps"),
        ("[task]\nname = 'simple-spread'\nagents = 0\nspawn = 'lines'", "task.agents"),
        ("[task]\nname = 'simple-spread'\nagents = 5\nspawn = 'ring'", "task.spawn: unknown spawn mode 'ring'"),
        ("[commander]\nkind = 'best'", "commander.kind: \"best\" is unknown; use pairwise"),
    ] {
        let error = RunConfig::from_toml(text).unwrap_err();
        assert!(std::error::Error::source(&error).is_none(), "{text}: reported twice");
        let error = error.to_string();
        assert!(error.contains(name), "{text}: {error}");
    }
}

#[test]
fn the_settings_of_another_algorithm_are_refused() {
    let text = |algorithm: &str, more: &str| {
        format!(
            "run.algorithm = '{algorithm}'\nexecutor.kind = 'flat'\n\
             task = {{ name = 'simple-spread', agents = 5, spawn = 'uniform', reward_target = 'team' }}\n{more}"
        )
    };
    for (algorithm, more) in [
        ("mappo", "mappo.gamma = 0.9"),
        ("qmix", "qmix.gamma = 0.9"),
        ("qmix", "mappo.gamma = 0.99"),
        ("maser", "qmix.gamma = 0.9\nmaser.alpha = 0.1"),
    ] {
        let config = RunConfig::from_toml(&text(algorithm, more)).unwrap();
        assert_eq!(RunConfig::from_toml(&config.to_toml().unwrap()).unwrap(), config, "{algorithm} {more}");
    }
    for (algorithm, more, problem) in [
        (
            "mappo",
            "qmix.double_q = false",
            "qmix.double_q: belongs to the algorithm qmix and maser; run.algorithm is mappo",
        ),
        (
            "mappo",
            "maser.alpha = 0.1",
            "maser.alpha: belongs to the algorithm maser; run.algorithm is mappo; remove it",
        ),
        ("qmix", "maser.alpha = 0.1", "maser.alpha: belongs to the algorithm maser; run.algorithm is qmix; remove it"),
        ("qmix", "mappo.epochs = 9", "mappo.epochs: belongs to the algorithm mappo; run.algorithm is qmix; remove it"),
        (
            "maser",
            "mappo.epochs = 9",
            "mappo.epochs: belongs to the algorithm mappo; run.algorithm is maser; remove it",
        ),
        ("qmix", "executor.centralised_critic = false", "executor.centralised_critic: belongs to the algorithm mappo"),
        ("qmix", "qmix.batch_episodes = 5001", "qmix.batch_episodes: 5001 is more than qmix.buffer_episodes = 5000"),
        ("qmix", "qmix.episodes_per_gradient_step = 7", "7 must divide collect.episodes_per_iteration = 40"),
        ("dqn", "", "run.algorithm: \"dqn\" is unknown; use mappo"),
    ] {
        let error = RunConfig::from_toml(&text(algorithm, more)).unwrap_err().to_string();
        assert!(error.contains(problem), "{algorithm} {more}: {error}");
    }
    let graph = text("qmix", "").replace("'flat'", "'magex'").replace(", reward_target = 'team'", "");
    assert!(
        RunConfig::from_toml(&graph)
            .unwrap_err()
            .to_string()
            .contains("executor.kind: magex is not an executor of qmix")
    );
    // Without a task: the first run's settings of MAPPO are left out.
    let config =
        RunConfig::from_toml("run.algorithm = 'qmix'\nexecutor = { kind = 'flat', observes = 'goals' }").unwrap();
    assert_eq!((config.mappo, config.task.agents), (MappoConfig::default(), 50));
}

#[test]
fn exploration_falls_linearly_and_stays() {
    let qmix = QmixConfig { epsilon_steps: 1000, ..QmixConfig::default() };
    assert_eq!([0, 500, 1000, u64::MAX].map(|steps| qmix.epsilon(steps)), [1.0, 0.525, 0.05, 0.05]);
}

#[test]
fn a_partial_task_takes_the_paper_sizes() {
    let config = RunConfig::from_toml("[task]\nname = 'simple-spread'\nagents = 5\nspawn = 'uniform'").unwrap();
    assert_eq!((config.task.side, config.task.horizon), (2.0, 60));
}

#[test]
fn a_renamed_key_is_refused_with_its_new_name() {
    for (old, new) in RENAMED {
        let (section, key) = old.rsplit_once('.').unwrap();
        let error = RunConfig::from_toml(&format!("[{section}]\n{key} = 1")).unwrap_err().to_string();
        assert_eq!(error, format!("configuration: {old}: this key is now {new}; rename it"));
        // The new one exists: it is refused for its value, not for its name.
        let (section, key) = new.rsplit_once('.').unwrap();
        let task = if section.starts_with("task") {
            "[task]\nname = 'push-ball'\nagents = 5\nspawn = 'uniform'\n"
        } else {
            ""
        };
        let error = RunConfig::from_toml(&format!("{task}[{section}]\n{key} = 'x'")).unwrap_err().to_string();
        assert!(error.starts_with(&format!("configuration: {new}: \"x\" is a text")), "{error}");
    }
}

#[test]
fn the_effective_configuration_reads_back_for_every_task() {
    for name in TaskName::SIMULATED {
        let task = TaskConfig { side: 5.5, ..TaskConfig::of(name, 4, Spawn::Uniform) };
        let config = RunConfig { task, ..RunConfig::default() };
        assert_eq!(RunConfig::from_toml(&config.to_toml().unwrap()).unwrap(), config, "{name}");
    }
}

#[test]
fn a_setting_of_another_executor_is_refused_and_so_is_a_reward_for_goals_that_are_not_seen() {
    let task = "[task]\nname = 'simple-spread'\nagents = 5\nspawn = 'uniform'\n";
    let error = |text: &str| RunConfig::from_toml(&format!("{task}{text}")).unwrap_err().to_string();
    for (key, value) in [
        ("observes", "'goals'"),
        ("nearest_first", "true"),
        ("agent_index", "false"),
        ("recurrent", "true"),
        ("centralised_critic", "false"),
        ("attention_blocks", "2"),
        ("attention_heads", "2"),
        ("frozen_graph", "true"),
    ] {
        let error = error(&format!("[executor]\nkind = 'local'\n{key} = {value}"));
        assert!(
            error.contains(&format!("executor.{key}: belongs to ")) && error.contains("is local; remove it"),
            "{error}"
        );
    }
    let flat = error("[executor]\nkind = 'flat'");
    assert!(flat.contains("task.reward_target") && flat.contains("or observe goals"), "{flat}");
    let team = "reward_target = 'team'\n[executor]\nkind = ";
    assert!(
        error(&format!("{team}'flat'\nrecurrent = true\nhidden = 40"))
            .contains("executor.hidden: 40 must be a multiple of 16")
    );
    assert!(error(&format!("{team}'mat'\nattention_heads = 3")).contains("executor.attention_heads: 3 must divide"));
    let sighted = RunConfig::from_toml(&format!("{task}[executor]\nkind = 'flat'\nobserves = 'goals'")).unwrap();
    assert!(sighted.executor.kind.fixed_team_size());
}

#[test]
fn keys_of_another_format_are_read_and_newer_ones_take_their_defaults() {
    let config =
        RunConfig::from_toml("[task]\nname = 'push-ball'\nagents = 5\nspawn = 'uniform'\n[mappo]\ngamma = 0.9")
            .unwrap();
    let written = serde_json::to_string(&config).unwrap();
    let mut keys: serde_json::Value = serde_json::from_str(&written).unwrap();
    assert_eq!(RunConfig::from_keys(&keys).unwrap(), config);
    for (section, key) in [("run", "algorithm"), ("executor", "frozen_graph"), ("mappo", "joint_ratio")] {
        keys[section].as_object_mut().unwrap().remove(key).unwrap();
    }
    keys.as_object_mut().unwrap().remove("qmix").unwrap();
    assert_eq!(RunConfig::from_keys(&keys).unwrap(), config);
    keys["mappo"]["alpha"] = 1.into();
    assert!(RunConfig::from_keys(&keys).unwrap_err().to_string().contains("mappo.alpha"));
}
