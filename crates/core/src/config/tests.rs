use super::raw::RENAMED;
use super::*;
use crate::task::TaskName;

#[test]
fn an_empty_file_is_the_default_run() {
    let config = RunConfig::from_toml("").unwrap();
    assert_eq!(config, RunConfig::default());
    assert_eq!(RunConfig::from_toml(&config.to_toml().unwrap()).unwrap(), config);
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
    for name in TaskName::ALL {
        let task = TaskConfig { side: 5.5, ..TaskConfig::of(name, 4, Spawn::Uniform) };
        let config = RunConfig { task, ..RunConfig::default() };
        assert_eq!(RunConfig::from_toml(&config.to_toml().unwrap()).unwrap(), config, "{name}");
    }
}
