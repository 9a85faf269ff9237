//! `magex check-environment`

use crate::external::{EnvironmentArgs, unavailable};
use crate::failure::usage;
use crate::options::CommonOptions;
use crate::output::Output;
use magex_actor::environment::{Environment, EnvironmentError, EnvironmentSource, Observed, Taken};
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::task::ExternalConfig;
use magex_proto::v1::CheckReply;
use magex_runtime::{exit, options};
use serde_json::json;
use std::time::Duration;

const AFTER_HELP: &str = "\
Examples:
  magex check-environment --environment 'python my_env.py'
  magex check-environment --environment unix:/run/env.sock --steps 2000
  magex check-environment --environment 'python my_env.py' --json

The environment plays some episodes of its own and compares what it does with \
    its interface; then it plays the same seeds and actions twice, in two processes. \
    docs/environments.md lists the rules.

Exit codes: 0 nothing is wrong, 1 something is, 64 wrong usage, 69 the \
    environment cannot be started or reached";

/// Check an environment of your own before you train in it.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct CheckEnvironmentArgs {
    #[command(flatten)]
    environment: EnvironmentArgs,
    /// Steps that are played, over as many episodes as they take.
    #[arg(long, value_name = "T", default_value_t = 300, value_parser = options::whole::<u32>(1, 1_000_000))]
    steps: u32,
    /// Seed of the first episode and of the actions.
    #[arg(long, value_name = "S", default_value_t = 1, value_parser = options::whole::<u32>(0, i32::MAX as u64))]
    seed: u32,
}

/// Worlds that play side by side.
const WORLDS: usize = 3;
/// Steps after which an episode is begun anew where the environment does not end it.
const CUT: u32 = 200;

pub(crate) fn run(args: &CheckEnvironmentArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let output = options.output();
    let Some(source) = args.environment.source()? else {
        return Err(usage("--environment: name the command that starts it, or its address"));
    };
    let mut environment = source.open().map_err(unavailable)?;
    let description = environment.description().clone();
    let steps_max = environment.steps_max();
    for (name, value) in properties(&description, steps_max) {
        output.say(format!("{name:<14} {value}"));
    }
    let allowed = Duration::from_secs(args.environment.environment_timeout.saturating_mul(10));
    let checked = environment.check(args.seed, args.steps, allowed).map_err(unavailable)?;
    drop(environment);
    let mut wrong: Vec<(String, String)> = Vec::new();
    let mut remarks = Vec::new();
    for violation in &checked.violations {
        let kind = if violation.warning { &mut remarks } else { &mut wrong };
        kind.push((violation.rule.clone(), violation.sentence.clone()));
    }
    let same = twice(&source, &description, args);
    match &same {
        Ok(None) => {}
        Ok(Some(where_)) if description.deterministic => {
            let sentence = format!("it says that it is deterministic, and in another process {where_} differs");
            wrong.push(("deterministic".to_owned(), sentence));
        }
        Ok(Some(_)) => {}
        Err(error) => wrong.push(("wire".to_owned(), error.to_string())),
    }
    report(&output, &checked, &wrong, &remarks, same.as_ref().is_ok_and(Option::is_none));
    let list = |of: &[(String, String)]| -> Vec<_> {
        of.iter().map(|(rule, sentence)| json!({ "rule": rule, "sentence": sentence })).collect()
    };
    output.result(&json!({
        "environment": description,
        "steps_max": steps_max,
        "violations": list(&wrong),
        "remarks": list(&remarks),
        "checked": checked.checked,
        "episodes": checked.episodes,
        "steps": checked.steps,
    }));
    Ok(if wrong.is_empty() { exit::OK } else { exit::FAILURE })
}

/// What an environment says about itself, for people.
fn properties(d: &ExternalConfig, steps_max: u32) -> Vec<(&'static str, String)> {
    let agents = match d.agent_names.len() {
        0..=6 => d.agent_names.join(", "),
        count => format!("{}, … ({count})", d.agent_names[..4].join(", ")),
    };
    let actions = if d.choices.is_empty() {
        format!("{} real numbers", d.moves())
    } else {
        let choices: Vec<String> = d.choices.iter().map(usize::to_string).collect();
        format!("{} choices{}", choices.join(" × "), if d.masks { ", masked" } else { "" })
    };
    let state = match d.state_width {
        0 => "none: the critic sees all observations".to_owned(),
        width => format!("{width} numbers"),
    };
    let end = if steps_max == 0 { "not said: set task.horizon".to_owned() } else { format!("after {steps_max} steps") };
    let yes = |yes: bool| if yes { "yes" } else { "no" }.to_owned();
    let deterministic = if d.deterministic { "yes" } else { "no: its runs cannot be reproduced" };
    vec![
        ("environment", d.environment.clone()),
        ("agents", agents),
        ("observation", format!("{} numbers", d.observation_width)),
        ("action", actions),
        ("state", state),
        ("end", end),
        ("deterministic", deterministic.to_owned()),
        ("success", yes(d.successes)),
        ("pictures", yes(d.renders)),
    ]
}

fn report(output: &Output, checked: &CheckReply, wrong: &[(String, String)], remarks: &[(String, String)], same: bool) {
    let CheckReply { episodes, steps, .. } = checked;
    let rules = checked.checked.len();
    output.say(format!("\nplayed {steps} steps in {episodes} episodes; {rules} rules checked"));
    if same {
        output.say("the same seeds and actions gave the same bits in two processes");
    }
    for (title, list) in [("wrong", wrong), ("remark", remarks)] {
        list.iter().for_each(|(rule, sentence)| output.say(format!("{title} ({rule}): {sentence}")));
    }
    output.say(match wrong.len() {
        0 => "nothing is wrong".to_owned(),
        1 => "1 thing is wrong".to_owned(),
        count => format!("{count} things are wrong"),
    });
}

/// Plays the same seeds and actions in two environments and compares everything that comes back: where it differs first.
fn twice(
    source: &EnvironmentSource,
    description: &ExternalConfig,
    args: &CheckEnvironmentArgs,
) -> Result<Option<String>, EnvironmentError> {
    let (mut one, mut other) = (source.open()?, source.open()?);
    let draws = || Key::new(u64::from(args.seed), Purpose::Controller, &[]).stream();
    let (mut first, mut second) = (Play::begin(&mut one, draws())?, Play::begin(&mut other, draws())?);
    for step in 0..=args.steps {
        if first.observed != second.observed {
            return Ok(Some(format!("step {step}")));
        }
        if step < args.steps {
            first.step(&mut one, description)?;
            second.step(&mut other, description)?;
        }
    }
    Ok(None)
}

/// Random actions in a few worlds; a world whose episode is over begins another one.
struct Play {
    draws: Stream,
    observed: Observed,
    steps: u32,
}

impl Play {
    fn begin(environment: &mut Environment, mut draws: Stream) -> Result<Self, EnvironmentError> {
        let observed = environment.reset((0..WORLDS).map(|_| draws.bits32() >> 1).collect())?;
        Ok(Self { draws, observed, steps: 0 })
    }

    fn step(&mut self, environment: &mut Environment, d: &ExternalConfig) -> Result<(), EnvironmentError> {
        let agents = d.agent_names.len();
        self.steps += 1;
        let anew = self.steps.is_multiple_of(CUT);
        let ended: Vec<u32> = (0..WORLDS as u32).filter(|&w| anew || self.observed.over(w as usize, agents)).collect();
        let restarts: Vec<(u32, u32)> = ended.into_iter().map(|w| (w, self.draws.bits32() >> 1)).collect();
        let (mut choices, mut moves) = (Vec::new(), Vec::new());
        let mut masks = self.observed.masks.iter();
        for _ in 0..WORLDS * agents {
            for &size in &d.choices {
                let allowed: Vec<u8> = match d.masks {
                    true => {
                        masks.by_ref().take(size).zip(0..=u8::MAX).filter(|(m, _)| **m == 1).map(|(_, c)| c).collect()
                    }
                    false => (0..size).map(|choice| choice as u8).collect(),
                };
                let pick = self.draws.below(allowed.len() as u32) as usize;
                choices.push(allowed.get(pick).copied().unwrap_or(0));
            }
            moves.extend((0..d.moves()).map(|_| self.draws.range(-3.0, 3.0) as f32));
        }
        self.observed = environment.step(&Taken { choices: &choices, moves: &moves }, &restarts)?;
        Ok(())
    }
}
