use super::*;

#[test]
fn the_paper_sizes_are_the_defaults() {
    for (n, side, horizon) in [(5, 2.0, 60), (20, 6.0, 100), (50, 10.0, 120)] {
        let task = TaskConfig::simple_spread(n, Spawn::Uniform);
        assert_eq!((task.side, task.horizon), (side, horizon));
        task.validate().unwrap();
    }
    assert_eq!(TaskConfig::simple_spread(200, Spawn::Uniform).horizon, 220);
}

#[test]
fn every_task_has_the_sizes_of_the_paper_and_refuses_the_settings_of_others() {
    let sizes = |name, agents| {
        let task = TaskConfig::of(name, agents, Spawn::Uniform);
        task.validate().unwrap();
        (task.side, task.horizon)
    };
    assert_eq!([sizes(TaskName::PushBall, 5), sizes(TaskName::PushBall, 20)], [(4.0, 100), (12.0, 200)]);
    assert_eq!([sizes(TaskName::Drones, 2), sizes(TaskName::Drones, 4)], [(3.0, 120), (3.0, 120)]);
    for name in [TaskName::SimpleSpread, TaskName::PushBall, TaskName::Drones] {
        let task = TaskConfig::of(name, 4, Spawn::Uniform);
        let keys: Table = toml::from_str(&toml::to_string(&task).unwrap()).unwrap();
        let read = |keys: &Table| super::read(keys.clone());
        assert_eq!(read(&keys).unwrap(), task);
        assert_eq!(task.shape(3).goals_per_agent, task.stages().len());
        for (owner, section, key) in [
            (TaskName::SimpleSpread, "reward", "bonus"),
            (TaskName::PushBall, "push_ball", "bonus"),
            (TaskName::Drones, "drones", "bonus"),
        ] {
            let mut keys = keys.clone();
            keys.insert(section.into(), Value::Table(Table::from_iter([(key.to_owned(), Value::Float(0.5))])));
            let refused = read(&keys).err().map(|error| error.to_string());
            let expected = format!("task.{section}: belongs to {owner}, the task is {name}; remove it");
            assert_eq!(refused, (owner != name).then_some(expected));
        }
        let other = TaskConfig { settings: TaskConfig::of(other_than(name), 4, Spawn::Uniform).settings, ..task };
        assert_eq!(other.validate().unwrap_err().field, "task.name");
    }
}

fn other_than(name: TaskName) -> TaskName {
    TaskName::SIMULATED.into_iter().find(|&other| other != name).unwrap()
}

#[test]
fn a_zero_is_not_a_default() {
    let read = |text: &str| {
        let keys: Table = toml::from_str(&format!("agents = 5\nspawn = 'uniform'\n{text}")).unwrap();
        super::read(keys)
    };
    assert_eq!(read("name = 'push-ball'").unwrap(), TaskConfig::of(TaskName::PushBall, 5, Spawn::Uniform));
    for key in ["side", "horizon", "layout_scale"] {
        let error = read(&format!("name = 'push-ball'\n{key} = 0")).unwrap_err().to_string();
        assert_eq!(error, format!("task.{key}: 0 is not a size; leave it out for the default"));
    }
    let error = read("name = 'simple-spread'\nreward.distance_unit = 0").unwrap_err();
    assert_eq!(error.field, "task.reward.distance_unit");
    let task = read("name = 'simple-spread'\nside = 7").unwrap();
    assert_eq!(task.reward().unwrap().distance_unit, 7.0);
    assert!(read("").unwrap_err().to_string().starts_with("task.name: missing; "));
}

#[test]
fn another_team_size_brings_its_own_map() {
    let task = TaskConfig::simple_spread(50, Spawn::Uniform);
    assert_eq!(task.clone().resized(5), TaskConfig::simple_spread(5, Spawn::Uniform));
    assert_eq!(TaskConfig { side: 9.0, ..task.clone() }.resized(50).side, 9.0);
    let mut own = task;
    set_reward(&mut own, |r| r.distance_unit = 3.0);
    assert_eq!(own.resized(5).reward().unwrap().distance_unit, 3.0);
}

fn set_reward(task: &mut TaskConfig, change: impl FnOnce(&mut RewardConfig)) {
    let TaskSettings::SimpleSpread(reward) = &mut task.settings else { panic!("{task:?}") };
    change(reward);
}

fn set_drones(task: &mut TaskConfig, change: impl FnOnce(&mut DroneConfig)) {
    let TaskSettings::Drones(drones) = &mut task.settings else { panic!("{task:?}") };
    change(drones);
}

#[test]
fn drones_that_do_not_fit_or_cannot_be_controlled_are_refused_with_the_remedy() {
    let refused = |change: fn(&mut TaskConfig), words: &str| {
        let mut task = TaskConfig::of(TaskName::Drones, 4, Spawn::Uniform);
        change(&mut task);
        let error = task.validate().unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    };
    refused(|t| t.agents = 60, "use a side of at least");
    refused(|t| t.side = 0.5, "use a side of at least");
    refused(|t| set_drones(t, |d| d.spacing = 0.1), "task.drones.spacing");
    refused(|t| set_drones(t, |d| d.physics_hz = 90), "attitude controller");
    refused(|t| set_drones(t, |d| d.physics_hz = 130), "multiple of 30");
    refused(|t| t.spawn = Spawn::Lines(None), "use uniform");
    refused(|t| set_drones(t, |d| d.crash = -1.0), "task.drones.crash");
}

#[test]
fn spawn_names_round_trip_and_unknown_ones_are_named() {
    for name in ["uniform", "lines", "lines-3", "authors", "authors-0"] {
        assert_eq!(String::from(name.parse::<Spawn>().unwrap()), name);
    }
    for name in ["ring", "lines-4", "", "lines3"] {
        let error = name.parse::<Spawn>().unwrap_err().to_string();
        assert!(error.contains(&format!("'{name}'; use uniform, lines")), "{error}");
    }
}

#[test]
fn the_fingerprint_sees_every_field() {
    let base = TaskConfig::simple_spread(20, Spawn::Lines(None));
    let mut other = base.clone();
    set_reward(&mut other, |r| r.collision = 0.5);
    assert_ne!(base.fingerprint(), other.fingerprint());
    assert_eq!(base.fingerprint(), base.clone().fingerprint());
}

#[test]
fn a_box_that_is_too_small_is_refused_with_a_remedy() {
    let mut task = TaskConfig::simple_spread(50, Spawn::Uniform);
    task.side = 1.0;
    assert!(task.validate().unwrap_err().to_string().contains("use a side of at least"));
}
