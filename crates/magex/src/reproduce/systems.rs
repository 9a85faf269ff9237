//! The paper's tables: which systems on which tasks, and what the paper reports.
//!
//! A system is one entry. A learner has a configuration for every task of its table and may set further keys; a controller has a
//! name. The values of the paper stand in the order of the tasks.

use crate::evaluate::Controller;
use magex_core::config::CommanderPolicy;

/// A table of the paper.
#[derive(Debug, PartialEq)]
pub(crate) struct PaperTable {
    /// Name on the command line and of folders.
    pub(crate) name: &'static str,
    pub(crate) title: &'static str,
    /// Where the paper has it.
    pub(crate) source: &'static str,
    /// By team size.
    pub(crate) tasks: &'static [Task],
    /// The first one is MAGE-X: the others are compared with it.
    pub(crate) systems: &'static [System],
}

/// A column of a table.
#[derive(Debug, PartialEq)]
pub(crate) struct Task {
    /// N.
    pub(crate) agents: usize,
    /// The configuration that controllers are evaluated with.
    pub(crate) config: &'static str,
}

/// A row of a table.
#[derive(Debug, PartialEq)]
pub(crate) struct System {
    /// As the paper calls it.
    pub(crate) name: &'static str,
    /// Name on the command line and of folders: lower case, no comma.
    pub(crate) id: &'static str,
    pub(crate) by: By,
    /// For every task; empty if the paper does not have the system.
    pub(crate) paper: &'static [Paper],
}

/// What chooses the actions.
#[derive(Debug, PartialEq)]
pub(crate) enum By {
    /// It is trained.
    Learner {
        /// A configuration for every task, or one for all of them: name, team size and starts are those of the task.
        configs: &'static [&'static str],
        /// Keys that differ from them, as for `magex train --set`.
        set: &'static [&'static str],
        /// The same for teams of [`LARGE`] agents and more.
        set_large: &'static [&'static str],
    },
    /// Nothing is trained; goals come from a scheduler without weights.
    Controller(Controller, CommanderPolicy),
}

/// Agents from which a team is large.
pub(crate) const LARGE: usize = 20;

/// Mean and standard deviation in the paper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Paper {
    pub(crate) success: [f64; 2],
    /// Of drones only.
    pub(crate) collisions: Option<[f64; 2]>,
}

const fn success(mean: f64, deviation: f64) -> Paper {
    Paper { success: [mean, deviation], collisions: None }
}

const fn drones(success: [f64; 2], collisions: [f64; 2]) -> Paper {
    Paper { success, collisions: Some(collisions) }
}

const SPREAD_5: &str = include_str!("../../../../deploy/configs/spread-5.toml");
const SPREAD_20: &str = include_str!("../../../../deploy/configs/spread-20.toml");
const SPREAD_50: &str = include_str!("../../../../deploy/configs/spread-50.toml");
const PUSH_BALL_5: &str = include_str!("../../../../deploy/configs/push-ball-5.toml");
const PUSH_BALL_20: &str = include_str!("../../../../deploy/configs/push-ball-20.toml");
const DRONES_2: &str = include_str!("../../../../deploy/configs/drones-2.toml");
const DRONES_4: &str = include_str!("../../../../deploy/configs/drones-4.toml");
const MAPPO: &str = include_str!("../../../../deploy/configs/baselines/mappo.toml");
const MAPPO_RNN: &str = include_str!("../../../../deploy/configs/baselines/mappo-rnn.toml");
const IPPO: &str = include_str!("../../../../deploy/configs/baselines/ippo.toml");
const MAPPO_GOALS: &str = include_str!("../../../../deploy/configs/baselines/mappo-goals.toml");
const MAT: &str = include_str!("../../../../deploy/configs/baselines/mat.toml");
const MAT_DEC: &str = include_str!("../../../../deploy/configs/baselines/mat-dec.toml");
const MAT_GOALS: &str = include_str!("../../../../deploy/configs/baselines/mat-goals.toml");
const DICG: &str = include_str!("../../../../deploy/configs/baselines/dicg.toml");
const DICG_FROZEN: &str = include_str!("../../../../deploy/configs/baselines/dicg-frozen.toml");
const QMIX: &str = include_str!("../../../../deploy/configs/baselines/qmix.toml");
const MASER: &str = include_str!("../../../../deploy/configs/baselines/maser.toml");
const DICG_GOALS: &str = include_str!("../../../../deploy/configs/baselines/dicg-goals.toml");

/// A large team's iteration has as many agent samples in fewer episodes, and its minibatches are larger.
const LARGE_TEAM: &[&str] = &["collect.episodes_per_iteration=16", "mappo.epochs=5", "mappo.minibatch_size=8000"];

/// An iteration of an off-policy learner has a gradient step for each of its episodes; with a large team it should not take minutes.
const LARGE_TEAM_OFF_POLICY: &[&str] = &["collect.episodes_per_iteration=8"];

/// With what MAGE-X pays for drones that are near, a team's reward teaches four of them to keep apart and nothing else.
const FLIGHT: &[&str] = &["task.drones.proximity=0", "task.drones.crash=1", "mappo.gamma=0.98"];

const SPREAD: &[Task] = &[
    Task { agents: 5, config: SPREAD_5 },
    Task { agents: 20, config: SPREAD_20 },
    Task { agents: 50, config: SPREAD_50 },
];
/// MAGE-X on the paper's three sizes of Simple Spread.
const MAGE_X_SPREAD: System = learner(
    "MAGE-X",
    "mage-x",
    &[SPREAD_5, SPREAD_20, SPREAD_50],
    &[],
    &[success(1.00, 0.01), success(1.00, 0.01), success(1.00, 0.01)],
);

/// The paper does not say how goals are assigned.
const MA_ASTAR: &[Paper] = &[success(1.00, 0.01), success(0.93, 0.03), success(0.77, 0.03)];

/// Every table, in the order of the paper.
#[rustfmt::skip]
pub(crate) const TABLES: &[PaperTable] = &[
    PaperTable {
        name: "spread",
        title: "Simple Spread",
        source: "main results, Simple Spread",
        tasks: SPREAD,
        systems: &[
            MAGE_X_SPREAD,
            baseline("MAPPO", "mappo", &[MAPPO], &[success(0.82, 0.03), success(0.50, 0.31), success(0.13, 0.02)]),
            baseline("MAT", "mat", &[MAT], &[success(1.00, 0.01), success(0.56, 0.26), success(0.11, 0.01)]),
            baseline("DICG", "dicg", &[DICG], &[success(0.71, 0.05), success(0.41, 0.04), success(0.12, 0.02)]),
            off_policy("MASER", "maser", &[MASER], &[success(0.06, 0.12), success(0.02, 0.23), success(0.01, 0.05)]),
            off_policy("QMIX", "qmix", &[QMIX], &[]),
            baseline("MAPPO, GRU", "mappo-rnn", &[MAPPO_RNN], &[]),
            baseline("IPPO", "ippo", &[IPPO], &[]),
            baseline("MAT-Dec", "mat-dec", &[MAT_DEC], &[]),
            baseline("DICG, frozen graph", "dicg-frozen", &[DICG_FROZEN], &[]),
            baseline("MAPPO + goals", "mappo-goals", &[MAPPO_GOALS], &[]),
            baseline("MAT + goals", "mat-goals", &[MAT_GOALS], &[]),
            baseline("DICG + goals", "dicg-goals", &[DICG_GOALS], &[]),
            controller("nearest landmark", "nearest", Controller::Nearest, &[]),
            controller("random actions", "random", Controller::Random, &[]),
        ],
    },
    PaperTable {
        name: "push-ball",
        title: "Push Ball",
        source: "main results, Push Ball",
        tasks: &[Task { agents: 5, config: PUSH_BALL_5 }, Task { agents: 20, config: PUSH_BALL_20 }],
        systems: &[
            learner("MAGE-X", "mage-x", &[PUSH_BALL_5, PUSH_BALL_20], &[], &[success(1.00, 0.01), success(1.00, 0.01)]),
            baseline("MAPPO", "mappo", &[MAPPO], &[success(0.20, 0.01), success(0.26, 0.01)]),
            baseline("MAT", "mat", &[MAT], &[success(0.32, 0.04), success(0.25, 0.02)]),
            baseline("DICG", "dicg", &[DICG], &[success(0.20, 0.01), success(0.36, 0.01)]),
            off_policy("MASER", "maser", &[MASER], &[success(0.01, 0.01), success(0.01, 0.01)]),
            controller("scripted", "scripted", Controller::Scripted, &[]),
            controller("nearest ball", "nearest", Controller::Nearest, &[]),
            controller("random actions", "random", Controller::Random, &[]),
        ],
    },
    PaperTable {
        name: "drones",
        title: "Drones",
        source: "main results, Drones",
        tasks: &[Task { agents: 2, config: DRONES_2 }, Task { agents: 4, config: DRONES_4 }],
        systems: &[
            learner("MAGE-X", "mage-x", &[DRONES_2, DRONES_4], &[], &[drones([0.95, 0.03], [0.02, 0.01]), drones([0.79, 0.07], [0.12, 0.01])]),
            learner("MAPPO", "mappo", &[MAPPO], FLIGHT, &[drones([0.83, 0.03], [0.10, 0.01]), drones([0.64, 0.01], [0.18, 0.02])]),
            learner("MAT", "mat", &[MAT], FLIGHT, &[drones([0.61, 0.01], [0.09, 0.01]), drones([0.34, 0.04], [0.06, 0.01])]),
            learner("DICG", "dicg", &[DICG], FLIGHT, &[drones([0.45, 0.02], [0.03, 0.02]), drones([0.12, 0.01], [0.07, 0.01])]),
            controller("scripted", "scripted", Controller::Scripted, &[]),
            controller("nearest landmark", "nearest", Controller::Nearest, &[]),
            controller("random actions", "random", Controller::Random, &[]),
        ],
    },
    PaperTable {
        name: "ablation",
        title: "Ablation in Simple Spread",
        source: "ablation study",
        tasks: &[Task { agents: 50, config: SPREAD_50 }],
        systems: &[
            learner("MAGE-X", "mage-x", &[SPREAD_50], &[], &[success(1.00, 0.01)]),
            learner("MAGE-X w. RG", "mage-x-rg", &[SPREAD_50], &["commander.kind=random"], &[success(0.83, 0.01)]),
            learner("MAGE-X-Atten", "mage-x-atten", &[SPREAD_50], &["executor.kind=attention"], &[success(0.93, 0.01)]),
            learner("MAGE-X-MLP", "mage-x-mlp", &[SPREAD_50], &["executor.kind=mlp"], &[success(0.50, 0.08)]),
        ],
    },
    PaperTable {
        name: "planner",
        title: "Planners in Simple Spread",
        source: "appendix, comparison with MA A*",
        tasks: SPREAD,
        systems: &[
            MAGE_X_SPREAD,
            planner("MA A*, exact goals", "astar", CommanderPolicy::Exact, MA_ASTAR),
            planner("MA A*, greedy goals", "astar-greedy", CommanderPolicy::Greedy, MA_ASTAR),
            planner("MA A*, random goals", "astar-random", CommanderPolicy::Random, MA_ASTAR),
            controller("ORCA", "orca", Controller::Orca, &[]),
            controller("scripted", "scripted", Controller::Scripted, &[]),
            controller("nearest landmark", "nearest", Controller::Nearest, &[]),
        ],
    },
];

type Text = &'static str;
type Texts = &'static [Text];

const fn learner(name: Text, id: Text, configs: Texts, set: Texts, paper: &'static [Paper]) -> System {
    System { name, id, by: By::Learner { configs, set, set_large: &[] }, paper }
}

/// A learner of the paper's comparison: one configuration, and other batches for large teams.
const fn baseline(name: Text, id: Text, configs: Texts, paper: &'static [Paper]) -> System {
    System { name, id, by: By::Learner { configs, set: &[], set_large: LARGE_TEAM }, paper }
}

/// The same of a learner with a replay buffer.
const fn off_policy(name: Text, id: Text, configs: Texts, paper: &'static [Paper]) -> System {
    System { name, id, by: By::Learner { configs, set: &[], set_large: LARGE_TEAM_OFF_POLICY }, paper }
}

/// A controller with the goals of the exact scheduler.
const fn controller(name: &'static str, id: &'static str, by: Controller, paper: &'static [Paper]) -> System {
    System { name, id, by: By::Controller(by, CommanderPolicy::Exact), paper }
}

/// MA A* with the goals of a scheduler.
const fn planner(name: &'static str, id: &'static str, goals: CommanderPolicy, paper: &'static [Paper]) -> System {
    System { name, id, by: By::Controller(Controller::Astar, goals), paper }
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::config::{RunConfig, Setting};
    use std::collections::BTreeSet;

    #[test]
    fn every_entry_is_complete_and_can_be_trained() {
        let mut names = BTreeSet::new();
        for table in TABLES {
            assert!(names.insert(table.name) && table.systems[0].id == "mage-x", "{}", table.name);
            let ids: BTreeSet<&str> = table.systems.iter().map(|system| system.id).collect();
            assert_eq!(ids.len(), table.systems.len(), "{}", table.name);
            for system in table.systems {
                let place = format!("{}, {}", table.name, system.name);
                let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
                assert!(system.id.chars().all(plain), "{place}");
                assert!([0, table.tasks.len()].contains(&system.paper.len()), "{place}: the paper's values");
                let By::Learner { configs, set, .. } = &system.by else { continue };
                assert!([1, table.tasks.len()].contains(&configs.len()), "{place}");
                for (k, task) in table.tasks.iter().enumerate() {
                    let own = RunConfig::from_toml(task.config).unwrap();
                    let name = format!("task.name={}", own.task.name);
                    let settings = set.iter().copied().chain([&name[..]]).map(|text| text.parse().unwrap());
                    let settings: Vec<Setting> = settings.collect();
                    let config = RunConfig::from_toml_with(configs.get(k).unwrap_or(&configs[0]), &settings).unwrap();
                    assert_eq!(own.task.agents, task.agents, "{place}");
                    assert!(configs.len() == 1 || config.task.agents == task.agents, "{place}");
                }
            }
        }
    }

    #[test]
    fn shares_are_shares() {
        for paper in TABLES.iter().flat_map(|table| table.systems).flat_map(|system| system.paper) {
            let values = paper.success.into_iter().chain(paper.collisions.into_iter().flatten());
            assert!(values.into_iter().all(|value| (0.0..=1.0).contains(&value)), "{paper:?}");
        }
    }
}
