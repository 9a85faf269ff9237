//! `magex learner`, `magex actor`, `magex commander`: one service each, from the same executable.

use crate::folder;
use crate::local;
use crate::parent_watch::ParentWatch;
use magex_actor::cli::ActorArgs;
use magex_commander::cli::CommanderArgs;
use magex_learner::cli::LearnerArgs;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

const LEARNER_HELP: &str = "\
Examples:
  magex learner --config run.toml --out runs/mine
  magex learner --listen 0.0.0.0:7000 --tls-cert server.pem \\
      --tls-key server.key --identities clients.toml
  magex learner --out runs/mine --resume
  magex learner --out runs/mine --resume-or-create --stay    restart policy
  magex learner --config new.toml --from runs/mine --out runs/next

Options can also be set in the environment; the command line takes precedence. \
    Actors and commander may start before or after the learner.

Exit codes: 0 the run is complete, 1 training failed, 64 wrong usage or \
    configuration, 69 the port is in use, 73 --out exists, cannot be written or is \
    written by another process, 75 stopped before the end (--resume continues), 130 interrupted twice";

const LEARNER_HTTP: &str = "Address for operators: the live page at /, /metrics for Prometheus and /healthz, over plain HTTP; \
    port 0 is any free one [default: none]";

const ACTOR_HELP: &str = "\
Examples:
  magex actor --learner http://10.0.0.1:7000 --commander http://10.0.0.2:7100
  magex actor --threads 4 --stay
  magex actor --learner https://10.0.0.1:7000 --tls-ca ca.pem --token-file token

An actor waits until it can reach the learner. The number of actors does not \
    change the results of the run.

Exit codes: 0 the run is complete or the actor was stopped, 64 wrong usage, \
    69 the learner rejected the actor, 130 interrupted twice";

const COMMANDER_HELP: &str = "\
Examples:
  magex commander --learner http://127.0.0.1:7000     follows a run
  magex commander --weights runs/mine                 serves a finished run
  magex commander --data missions                     no model; keeps missions
  magex commander --listen 0.0.0.0:7100 --tls-cert server.pem \\
      --tls-key server.key --identities clients.toml

Query it with magex assign, or over gRPC (reflection is on); see \
    docs/commander.md.

Exit codes: 0 stopped, 64 wrong usage or weights, 69 the port is in use, \
    70 internal error, 73 --data cannot be used, 130 interrupted twice";

/// Called through a link named `magex-learner`, this program behaves like `magex learner`; the same for the other services.
pub(crate) fn by_name(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = arguments.collect();
    let name = arguments.first().and_then(|name| Path::new(name).file_name()?.to_str()?.strip_prefix("magex-"));
    if let Some(role) = name.filter(|name| ["learner", "actor", "commander"].contains(name)).map(OsString::from) {
        arguments.insert(1, role);
    }
    arguments
}

/// Run the learner alone: leases shards to actors, trains, broadcasts weights.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = LEARNER_HELP, mut_arg("http", |http| http.help(LEARNER_HTTP)))]
pub(crate) struct LearnerRole {
    #[command(flatten)]
    args: LearnerArgs,
    #[command(flatten)]
    parent: ParentWatch,
}

/// Run an actor alone: rolls out episodes for a learner.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = ACTOR_HELP)]
pub(crate) struct ActorRole {
    #[command(flatten)]
    args: ActorArgs,
    #[command(flatten)]
    parent: ParentWatch,
}

/// Run the goal commander alone: assigns goals to agents.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = COMMANDER_HELP)]
pub(crate) struct CommanderRole {
    /// The same as --weights RUN.
    #[arg(long, value_name = "RUN", conflicts_with = "weights", hide = true)]
    model: Option<PathBuf>,
    #[command(flatten)]
    args: CommanderArgs,
    #[command(flatten)]
    parent: ParentWatch,
}

pub(crate) fn learner(role: &LearnerRole) -> anyhow::Result<u8> {
    role.parent.start()?;
    Ok(magex_learner::cli::run(role.args.clone(), local::judge)?)
}

pub(crate) fn actor(role: &ActorRole) -> anyhow::Result<u8> {
    role.parent.start()?;
    Ok(magex_actor::cli::run(role.args.clone())?)
}

pub(crate) fn commander(role: &CommanderRole) -> anyhow::Result<u8> {
    role.parent.start()?;
    let mut args = role.args.clone();
    if let Some(run) = &role.model {
        folder::config_of(run)?;
        args.weights = Some(run.clone());
    }
    Ok(magex_commander::cli::run(args)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_the_service_that_it_is_named_after() {
        let called = |line: &str| {
            let words = by_name(line.split(' ').map(OsString::from));
            words.iter().map(|word| word.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(called("/bin/magex-learner --resume"), "/bin/magex-learner learner --resume");
        assert_eq!(called("magex-actor"), "magex-actor actor");
        assert_eq!(called("magex-commander --help"), "magex-commander commander --help");
        for other in ["magex train", "/usr/magex-learner/magex eval", "magex-other x"] {
            assert_eq!(called(other), other);
        }
    }
}
