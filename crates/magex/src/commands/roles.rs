//! `magex learner`, `magex actor`, `magex commander`: the services from the one executable, each on its own.

use crate::folder;
use magex_actor::cli::ActorArgs;
use magex_commander::cli::CommanderArgs;
use magex_learner::cli::LearnerArgs;
use magex_runtime::exit::{self, Failure};
use std::ffi::OsString;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

const LEARNER_HELP: &str = "\
Examples:
  magex learner --config run.toml --out runs/mine
  magex learner --listen 0.0.0.0:7000 --tls-cert server.pem --tls-key server.key --identities who.toml
  magex learner --out runs/mine --resume
  magex learner --out runs/mine --resume-or-create --stay     for a restart policy

Options can be set in the environment too; options of the command win. Actors and commander may start
before or after it.

Exit codes: 0 the run is complete, 1 training failed, 64 wrong usage or configuration, 69 the port is in
use, 73 --out exists or cannot be written, 75 stopped before the end (--resume continues),
130 interrupted twice";

const ACTOR_HELP: &str = "\
Examples:
  magex actor --learner http://10.0.0.1:7000 --commander http://10.0.0.2:7100
  magex actor --threads 4 --stay
  magex actor --learner https://10.0.0.1:7000 --tls-ca ca.pem --token-file token

An actor that finds no learner waits for one. How many actors there are changes no number of the run.

Exit codes: 0 the run is complete or the actor was told to stop, 64 wrong usage, 69 the learner refused,
130 interrupted twice";

const COMMANDER_HELP: &str = "\
Examples:
  magex commander --learner http://127.0.0.1:7000     follows a run
  magex commander --weights runs/mine                 serves a finished run
  magex commander --data missions                     exact, makespan, greedy and random; missions are kept
  magex commander --listen 0.0.0.0:7100 --tls-cert server.pem --tls-key server.key --identities who.toml

Ask it with magex assign, or over gRPC (reflection is on); docs/commander.md has more.

Exit codes: 0 told to stop, 64 wrong usage or weights, 69 the port is in use, 70 a fault of this program,
73 --data cannot be used, 130 interrupted twice";

/// A service under its own name: what is called `magex-learner` and is this program does what `magex learner` does. So one
/// program and three links to it are all four.
pub(crate) fn by_name(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = arguments.collect();
    let name = arguments.first().and_then(|name| Path::new(name).file_name()?.to_str()?.strip_prefix("magex-"));
    if let Some(role) = name.filter(|name| ["learner", "actor", "commander"].contains(name)).map(OsString::from) {
        arguments.insert(1, role);
    }
    arguments
}

/// Run the learner alone: leases work to actors, trains, broadcasts weights.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = LEARNER_HELP)]
pub(crate) struct LearnerRole {
    #[command(flatten)]
    args: LearnerArgs,
    #[command(flatten)]
    leash: Leash,
}

/// Run an actor alone: rolls out episodes for a learner.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = ACTOR_HELP)]
pub(crate) struct ActorRole {
    #[command(flatten)]
    args: ActorArgs,
    #[command(flatten)]
    leash: Leash,
}

/// Run the goal commander alone: answers who goes where.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = COMMANDER_HELP)]
pub(crate) struct CommanderRole {
    /// The same as --weights RUN
    #[arg(long, value_name = "RUN", conflicts_with = "weights", hide = true)]
    model: Option<PathBuf>,
    #[command(flatten)]
    args: CommanderArgs,
    #[command(flatten)]
    leash: Leash,
}

/// How a service that was started by another process learns that this process is gone.
#[derive(Debug, Clone, Copy, clap::Args)]
struct Leash {
    /// Stop when standard input ends.
    #[arg(long = LEASH, hide = true)]
    leash: bool,
}

/// Name of the option that ties a service to whoever holds the other end of its standard input.
pub(crate) const LEASH: &str = "stop-with-stdin";

/// A service that was told to stop is gone after this time.
const GRACE: Duration = Duration::from_secs(8);

pub(crate) fn learner(role: &LearnerRole) -> anyhow::Result<u8> {
    role.leash.tie()?;
    Ok(magex_learner::cli::run(role.args.clone())?)
}

pub(crate) fn actor(role: &ActorRole) -> anyhow::Result<u8> {
    role.leash.tie()?;
    Ok(magex_actor::cli::run(role.args.clone())?)
}

pub(crate) fn commander(role: &CommanderRole) -> anyhow::Result<u8> {
    role.leash.tie()?;
    let mut args = role.args.clone();
    if let Some(run) = &role.model {
        folder::config_of(run)?;
        args.weights = Some(run.clone());
    }
    Ok(magex_commander::cli::run(args)?)
}

impl Leash {
    fn tie(self) -> Result<(), Failure> {
        if !self.leash {
            return Ok(());
        }
        let watch = || {
            let mut ignored = [0u8; 64];
            // Ends with the pipe, however the process at its other end went.
            while matches!(std::io::stdin().read(&mut ignored), Ok(1..)) {}
            // The same way out as for a person's SIGTERM.
            let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::TERM);
            std::thread::sleep(GRACE);
            std::process::exit(i32::from(exit::TEMPORARY));
        };
        let thread = std::thread::Builder::new().name("magex-leash".into()).spawn(watch);
        thread.map(drop).map_err(|error| Failure::new(exit::INTERNAL, error))
    }
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
