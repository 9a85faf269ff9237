use super::*;
use crate::train::algorithm::Algorithm;
use crate::train::commander_ppo::CommanderPpo;
use magex_core::config::{ExecutorConfig, ExecutorKind, RunConfig};
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Spawn, TaskConfig};

fn learned() -> Learned {
    let config = RunConfig {
        task: TaskConfig::simple_spread(5, Spawn::Uniform),
        executor: ExecutorConfig { kind: ExecutorKind::Local, hidden: 16, ..ExecutorConfig::default() },
        ..RunConfig::default()
    };
    let commander = CommanderPpo::new(&config.commander, &config.task, 1);
    Learned::init(&config, &Algorithm::new(&config).unwrap(), &commander).unwrap()
}

fn progress(iteration: u32) -> Progress {
    Progress {
        run_id: "r".into(),
        config_sha256: "c".into(),
        config: String::new(),
        iteration,
        joint_env_steps: 7,
        on_target: 1,
        wall_s: 0.1 + 0.2,
    }
}

/// Different in every part from the fresh one.
fn moved(mut learned: Learned) -> Learned {
    for (network, steps) in learned.networks.iter_mut().zip(3..) {
        network.params.values[3] = 0.1 * steps as f32;
        network.params.values[0] = -7.25;
        network.params.values[1] = 1e-20;
        network.moments.first[2] = 3e-9;
        network.moments.second[1] = 1e-12;
        network.moments.steps = steps;
    }
    learned.value_norm.update([0.3, 1.7].into_iter());
    learned
}

/// A list of networks that no algorithm of today has.
#[test]
fn networks_of_another_algorithm_come_back_under_their_own_names() {
    let run = tempfile::tempdir().unwrap();
    let draw = |name: &str, k: u32| {
        let mut values = learned().networks[0].params.clone();
        values = Params::init(values.entries, Key::new(7, Purpose::Init, &[k]).stream());
        Network::new(name, values, k == 0)
    };
    let networks = ["utility", "utility_target", "mixer"].into_iter().zip(0..).map(|(name, k)| draw(name, k));
    let fresh = Learned { networks: networks.collect(), ..learned() };
    let mut changed = moved(fresh.clone());
    changed.networks[2].params.values[5] = 9.0;
    write(run.path(), &progress(1), &changed, 3).unwrap();
    assert_eq!(read_latest(run.path(), &fresh).unwrap().1, changed);
    let published = changed.broadcast().unwrap();
    let entries = || fresh.networks[0].params.entries.clone();
    assert_eq!(Params::load(entries(), &published, "utility").unwrap(), changed.networks[0].params);
    assert!(Params::load(entries(), &published, "mixer").is_err());
    // Networks that the checkpoint does not have are missed by name.
    let error = read_latest(run.path(), &learned()).unwrap_err().to_string();
    assert!(error.contains("adam_steps.actor is missing"), "{error}");
}

#[test]
fn a_folder_of_a_format_before_is_rejected_by_name() {
    let run = tempfile::tempdir().unwrap();
    let state = learned();
    let folder = write(run.path(), &progress(1), &state, 3).unwrap();
    check_format(run.path()).unwrap();
    for (format, writer) in [
        (3, "0.2.0 (commit e39ac1d or before)"),
        (2, "0.2.0 (commit aa62ae4 or before)"),
        (1, "0.1.0 (commit 389f705)"),
    ] {
        fs::write(folder.join(MANIFEST), format!("{{\"format\": {format}, \"sha256\": {{}}}}")).unwrap();
        // Damage, as long as it is in one file only.
        check_format(run.path()).unwrap();
        fs::write(folder.join("state.json"), format!("{{\"format\": {format}}}")).unwrap();
        for error in [check_format(run.path()).unwrap_err(), read(&folder, &state).unwrap_err()] {
            let expected = format!("written by magex {writer}, which reads it; this is magex 0.2.0");
            assert!(error.to_string().contains(&expected), "{error}");
        }
    }
}

#[test]
fn everything_that_learning_changes_comes_back_bit_for_bit() {
    let run = tempfile::tempdir().unwrap();
    let (fresh, changed) = (learned(), moved(learned()));
    write(run.path(), &progress(12), &changed, 3).unwrap();
    let (p, back, skipped) = read_latest(run.path(), &fresh).unwrap();
    assert_eq!((p, &back), (progress(12), &changed));
    assert!(skipped.is_empty());
    assert_eq!(back.weights().unwrap(), changed.weights().unwrap());
}

#[test]
fn only_the_newest_are_kept_and_the_same_iteration_can_be_written_again() {
    let run = tempfile::tempdir().unwrap();
    let state = learned();
    for iteration in [1, 2, 3, 4, 4] {
        write(run.path(), &progress(iteration), &state, 2).unwrap();
    }
    let names: Vec<_> = list(run.path()).iter().map(|p| p.file_name().unwrap().to_owned()).collect();
    assert_eq!(names, ["000003", "000004"]);
}

#[test]
fn a_flipped_byte_in_any_file_is_seen_and_the_previous_checkpoint_is_used() {
    for file in ["weights.safetensors", "optimiser.safetensors", "state.json", "manifest.json"] {
        let run = tempfile::tempdir().unwrap();
        let (old, new) = (learned(), moved(learned()));
        write(run.path(), &progress(1), &old, 3).unwrap();
        let folder = write(run.path(), &progress(2), &new, 3).unwrap();
        let path = folder.join(file);
        let mut bytes = std::fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        std::fs::write(&path, bytes).unwrap();
        let (p, _, skipped) = read_latest(run.path(), &old).unwrap();
        assert_eq!(p.iteration, 1, "{file}");
        assert!(skipped[0].to_string().contains("000002"), "{}", skipped[0]);
    }
}

#[test]
fn a_half_written_or_truncated_checkpoint_never_counts() {
    let run = tempfile::tempdir().unwrap();
    let state = learned();
    write(run.path(), &progress(1), &state, 3).unwrap();
    // What a kill leaves behind at each step of writing: a temporary folder with some of the files.
    let temporary = run.path().join("checkpoints/.000002.tmp");
    std::fs::create_dir(&temporary).unwrap();
    for file in FILES {
        std::fs::write(temporary.join(file), b"half").unwrap();
        assert_eq!(read_latest(run.path(), &state).unwrap().0.iteration, 1);
    }
    // The next attempt at the same iteration starts over.
    write(run.path(), &progress(2), &state, 3).unwrap();
    assert_eq!(read_latest(run.path(), &state).unwrap().0.iteration, 2);
    for file in ["manifest.json", "weights.safetensors"] {
        std::fs::remove_file(run.path().join("checkpoints/000002").join(file)).unwrap();
        assert_eq!(read_latest(run.path(), &state).unwrap().0.iteration, 1);
    }
}

#[test]
fn no_checkpoint_and_another_architecture_are_clear_errors() {
    let run = tempfile::tempdir().unwrap();
    let state = learned();
    assert!(matches!(read_latest(run.path(), &state), Err(CheckpointError::None(_))));
    let folder = write(run.path(), &progress(1), &state, 3).unwrap();
    let mut other = state.clone();
    other.networks[0].params.entries[0].shape.reverse();
    let error = read(&folder, &other).unwrap_err().to_string();
    assert!(error.contains("actor.own.weight"), "{error}");
}

#[test]
fn a_flip_anywhere_in_the_manifest_never_gives_anything_but_one_of_the_two_checkpoints() {
    let run = tempfile::tempdir().unwrap();
    let (old, mut new) = (moved(learned()), moved(learned()));
    new.networks[0].params.values[0] += 1.0;
    write(run.path(), &progress(1), &old, 3).unwrap();
    let path = write(run.path(), &progress(2), &new, 3).unwrap().join("manifest.json");
    let whole = std::fs::read(&path).unwrap();
    for place in 0..whole.len() {
        let mut bytes = whole.clone();
        bytes[place] ^= 1 << (place % 8);
        std::fs::write(&path, bytes).unwrap();
        let (found, state, _) = read_latest(run.path(), &old).unwrap_or_else(|error| panic!("byte {place}: {error}"));
        assert!((found.iteration, &state) == (1, &old) || (found.iteration, &state) == (2, &new), "byte {place}");
    }
}

#[test]
fn a_checkpoint_that_was_moved_aside_is_found_as_long_as_nothing_is_in_its_place() {
    let run = tempfile::tempdir().unwrap();
    let state = learned();
    let folder = write(run.path(), &progress(2), &state, 1).unwrap();
    let aside = folder.with_file_name(".000002.old");
    std::fs::rename(&folder, &aside).unwrap();
    assert_eq!(read_latest(run.path(), &state).unwrap().0.iteration, 2);
    write(run.path(), &progress(2), &state, 1).unwrap();
    assert_eq!(list(run.path()), [folder]);
    assert!(!aside.exists());
}

#[test]
fn when_all_are_damaged_the_newest_is_named() {
    let run = tempfile::tempdir().unwrap();
    let state = learned();
    for iteration in [1, 2] {
        let folder = write(run.path(), &progress(iteration), &state, 3).unwrap();
        std::fs::write(folder.join("weights.safetensors"), b"x").unwrap();
    }
    let error = read_latest(run.path(), &state).unwrap_err().to_string();
    assert!(error.contains("none of the 2 checkpoints") && error.contains("000002/weights.safetensors"), "{error}");
}

#[test]
fn what_a_kill_left_half_written_is_removed_and_nothing_else() {
    let run = tempfile::tempdir().unwrap();
    let changed = moved(learned());
    write(run.path(), &progress(12), &changed, 3).unwrap();
    let checkpoints = run.path().join("checkpoints");
    for name in [".000013.tmp", ".000009.old", ".notes.tmp", "mine"] {
        fs::create_dir(checkpoints.join(name)).unwrap();
    }
    fs::write(checkpoints.join(".000013.tmp/weights.safetensors"), "half").unwrap();
    clean(&FileSystem, run.path(), 9);
    let left = |name: &str| checkpoints.join(name).exists();
    assert!(!left(".000013.tmp"));
    assert!(left("000012") && left(".000009.old") && left(".notes.tmp") && left("mine"));
    clean(&FileSystem, &run.path().join("nowhere"), 9);
}
