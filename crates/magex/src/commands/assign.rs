//! `magex assign`

use crate::failure::{unavailable, usage};
use crate::options::CommonOptions;
use crate::output::{Table, note};
use anyhow::Context as _;
use magex_assign::POWERS;
use magex_core::rng::{Key, Purpose};
use magex_proto::goals::AssignmentMethod;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_proto::{COMMANDER, SERVICES};
use magex_runtime::exit;
use magex_runtime::options;
use magex_runtime::peer::Remote;
use magex_runtime::security::CallerArgs;
use serde_json::{Value, json};
use std::io::Read as _;
use std::path::Path;
use std::time::{Duration, Instant};
use tonic::{Code, Status};

const AFTER_HELP: &str = "\
Examples:
  magex assign --agents '[[0,0],[1,0]]' --goals '[[1,1],[0,1]]'
  magex assign --agents team.json --scheduler learned
  generate-team | magex assign --agents - --json
  magex assign --connect http://10.0.0.2:7100 --random 50 --seed 7

A team file is {\"agents\": [[x, y], …], \"goals\": [[x, y], …]} with two or \
    three coordinates, and what else there is to say: costs (a matrix in place of \
    the distances; null forbids a pair), agent_speeds, agent_offsets, agent_loads, \
    balance, goal_weights, goal_capacities, goal_earliest, goal_due, precedence \
    ([[goal, after], …]), pinned, forbidden and current ([[agent, goal], …]), \
    switching_cost, power. With more agents than goals some agents get no goal, and \
    vice versa. gap: excess of the summed cost over the minimum.

Exit codes: 0 success, 1 the commander rejected the request or failed, 64 wrong \
    usage or positions, 69 the commander cannot be reached";

/// Request goal assignments from a running commander.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct AssignArgs {
    /// The commander's address.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7100", env = "MAGEX_COMMANDER")]
    pub(crate) connect: String,
    /// Credentials for the commander.
    #[command(flatten)]
    pub(crate) security: CallerArgs,
    /// Positions of the agents: JSON, a file, or - for standard input; a team file contains the goals too.
    #[arg(long, value_name = "FILE|JSON|-", required_unless_present = "random", conflicts_with = "random")]
    pub(crate) agents: Option<String>,
    /// Positions of the goals: JSON or a file.
    #[arg(long, value_name = "FILE|JSON", conflicts_with = "random")]
    pub(crate) goals: Option<String>,
    /// Use a random team of N agents and N goals, uniform in a square with the density of the task.
    #[arg(long, value_name = "N", value_parser = options::whole::<u32>(1, 5000))]
    pub(crate) random: Option<u32>,
    /// Assignment method.
    #[arg(long, value_enum, value_name = "KIND", default_value = "exact")]
    pub(crate) scheduler: Kind,
    /// Exponent of the costs: 2 lets the last agent arrive sooner [default: as in the team file, or 1].
    #[arg(long, value_name = "P", value_parser = power)]
    pub(crate) power: Option<f64>,
    /// How the goals are chosen.
    #[arg(long, value_enum, value_name = "MODE", default_value = "greedy")]
    pub(crate) mode: Choice,
    /// Seed of random choices.
    #[arg(long, value_name = "S", value_parser = options::whole::<u64>(0, u64::MAX))]
    pub(crate) seed: Option<u64>,
}

/// Assignment methods, with their numbers on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Kind {
    /// The trained commander.
    Learned = v1::AssignmentMethod::Learned as isize,
    /// Minimal summed cost.
    Exact = v1::AssignmentMethod::Exact as isize,
    /// The nearest free pair, repeatedly.
    Greedy = v1::AssignmentMethod::Greedy as isize,
    /// A random matching.
    Random = v1::AssignmentMethod::Random as isize,
    /// Minimal largest cost.
    Makespan = v1::AssignmentMethod::Makespan as isize,
}

/// How goals are chosen, with their numbers on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Choice {
    /// The most likely ones.
    Greedy = v1::Mode::Greedy as isize,
    /// Sampled.
    Sampled = v1::Mode::Sampled as isize,
}

pub(crate) fn run(args: &AssignArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let team = team(args)?;
    let request = v1::AssignRequest {
        scheduler: args.scheduler as i32,
        mode: args.mode as i32,
        seed: args.seed,
        power: args.power.or(team.power),
        ..team
    };
    let settings = args.security.read().map_err(usage)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let clock = Instant::now();
    let commander = Remote { url: args.connect.clone(), settings, wanted: COMMANDER, known: &SERVICES };
    let response = runtime.block_on(async {
        let channel = commander.channel().map_err(|error| usage(format!("--connect: {error}")))?;
        let mut client = CommanderServiceClient::new(channel);
        let call = client.assign(request);
        match tokio::time::timeout(Duration::from_secs(30), call).await {
            Ok(Ok(answer)) => Ok(answer.into_inner()),
            Ok(Err(status)) => Err(rejected(&commander, &status).await),
            Err(_) => Err(unavailable(format!("the commander at {} did not answer within 30 s", args.connect))),
        }
    })?;
    show(args, options, &response, clock.elapsed().as_secs_f64());
    Ok(exit::OK)
}

async fn rejected(commander: &Remote, status: &Status) -> anyhow::Error {
    let explained = commander.explain(status).await;
    match status.code() {
        Code::InvalidArgument => usage(status.message()),
        // A status that was explained is not the commander's own.
        _ if explained.text != status.message() => {
            let start = if explained.permanent { "" } else { "; start one with `magex commander`" };
            unavailable(format!("no commander at {}: {}{start}", commander.url, explained.text))
        }
        Code::Unavailable | Code::DeadlineExceeded => unavailable(format!("{}: {}", commander.url, status.message())),
        code => anyhow::anyhow!("the commander rejected the request: {code}: {}", status.message()),
    }
}

fn show(args: &AssignArgs, options: &CommonOptions, response: &v1::AssignResponse, round_trip: f64) {
    let output = options.output();
    // Costs that are not distances have a column of their own.
    let priced = response.pairs.iter().any(|pair| pair.cost != pair.distance);
    let timed = response.last_arrival.is_some();
    let columns = [
        ("agent", true),
        ("goal", true),
        ("distance", true),
        ("cost", priced),
        ("arrival", timed),
        ("probability", true),
    ];
    let heading: Vec<&str> = columns.into_iter().filter(|(_, shown)| *shown).map(|(name, _)| name).collect();
    let mut table = Table::new(0, &heading);
    for pair in &response.pairs {
        let name = |name: &str, index: u32| if name.is_empty() { index.to_string() } else { name.to_owned() };
        let cells = [
            name(&pair.agent_id, pair.agent_index),
            name(&pair.goal_id, pair.goal_index),
            format!("{:.4}", pair.distance),
            format!("{:.4}", pair.cost),
            format!("{:.4}", pair.arrival.unwrap_or(0.0)),
            pair.probability.map_or_else(|| "-".into(), |p| format!("{p:.4}")),
        ];
        table.row(cells.into_iter().zip(columns).filter(|(_, (_, shown))| *shown).map(|(cell, _)| cell).collect());
    }
    output.say(table.to_string());
    for (what, left) in [("agents", &response.agents_without_goal), ("goals", &response.goals_without_agent)] {
        if !left.is_empty() {
            let told = |member: &v1::Unassigned| match member.reason() {
                v1::UnassignedReason::Outnumbered => member.index.to_string(),
                other => format!("{} ({})", member.index, reason(other)),
            };
            let list: Vec<String> = left.iter().map(told).collect();
            output.say(format!("  unassigned {what}: {}", list.join(", ")));
        }
    }
    let answered = match response.scheduler() {
        v1::AssignmentMethod::Unspecified => "unknown",
        method => AssignmentMethod::from(method).name(),
    };
    let weights = &response.sha256[..12.min(response.sha256.len())];
    let version = match weights {
        "" => String::new(),
        _ => format!(" (version {}, weights {weights})", response.version),
    };
    output.say(format!(
        "\n  summed {} {:.4}, minimum {}, gap {}, largest {:.4}{}\n  answered by {answered}{version} in {:.2} ms ({:.1} ms with the network)",
        if priced { "cost" } else { "distance" },
        response.cost,
        response.exact_cost.map_or_else(|| "not computed".into(), |cost| format!("{cost:.4}")),
        response.gap.map_or_else(|| "unknown".into(), |gap| format!("{:.2} %", 100.0 * gap)),
        response.largest_cost,
        if priced { format!(", distance {:.4}", response.distance) } else { String::new() },
        1e3 * response.seconds,
        1e3 * round_trip
    ));
    if !response.fallback_reason.is_empty() {
        let reason = &response.fallback_reason;
        note(format!("note: {answered} answered instead of {:?}: {reason}", args.scheduler).to_lowercase());
    }
    let pairs = response.pairs.iter().map(|p| {
        json!({
            "agent": p.agent_index, "goal": p.goal_index, "distance": p.distance, "cost": p.cost, "arrival": p.arrival,
            "probability": p.probability,
        })
    });
    let left = |members: &[v1::Unassigned]| -> Vec<Value> {
        members.iter().map(|m| json!({ "index": m.index, "reason": reason(m.reason()) })).collect()
    };
    output.result(&json!({
        "pairs": pairs.collect::<Vec<_>>(),
        "unassigned_agents": response.unassigned_agents,
        "unassigned_goals": response.unassigned_goals,
        "agents_without_goal": left(&response.agents_without_goal),
        "goals_without_agent": left(&response.goals_without_agent),
        "cost": response.cost,
        "distance": response.distance,
        "last_arrival": response.last_arrival,
        "unserved_cost": response.unserved_cost,
        "exact_cost": response.exact_cost,
        "gap": response.gap,
        "largest_cost": response.largest_cost,
        "scheduler": answered,
        "version": response.version,
        "weights_sha256": response.sha256,
        "run_id": response.run_id,
        "fallback_reason": response.fallback_reason,
        "seconds": response.seconds,
        "round_trip_seconds": round_trip,
    }));
}

/// Why a member is left over, in words.
fn reason(reason: v1::UnassignedReason) -> &'static str {
    match reason {
        v1::UnassignedReason::Unspecified => "unknown",
        v1::UnassignedReason::Outnumbered => "outnumbered",
        v1::UnassignedReason::Forbidden => "forbidden",
        v1::UnassignedReason::Conflict => "partners taken",
        v1::UnassignedReason::Inactive => "inactive",
        v1::UnassignedReason::TooLate => "too late",
        v1::UnassignedReason::NotOpen => "not open",
    }
}

/// The team of the arguments, as far as it is given.
fn team(args: &AssignArgs) -> anyhow::Result<v1::AssignRequest> {
    let of_points = |agents: &[Vec<f64>], goals: &[Vec<f64>]| {
        let (agents, goals) = (Some(positions("agents", agents)?), Some(positions("goals", goals)?));
        Ok(v1::AssignRequest { agents, goals, ..Default::default() })
    };
    if let Some(n) = args.random {
        let side = (2.0 * f64::from(n)).sqrt();
        let mut stream = Key::new(args.seed.unwrap_or(0), Purpose::Request, &[n]).stream();
        let mut point = |_| (0..2).map(|_| stream.range(-side / 2.0, side / 2.0)).collect::<Vec<f64>>();
        let agents: Vec<_> = (0..n).map(&mut point).collect();
        return of_points(&agents, &(0..n).map(&mut point).collect::<Vec<_>>());
    }
    let agents = read("agents", args.agents.as_deref().unwrap_or_default())?;
    let agents = parse("agents", &agents)?;
    if let Some(goals) = &args.goals {
        let goals = parse("goals", &read("goals", goals)?)?;
        return of_points(&points("--agents", &agents)?, &points("--goals", &goals)?);
    }
    let form = "give {\"agents\": [[x, y], …], \"goals\": [[x, y], …]}, or add --goals";
    let Value::Object(team) = agents else { return Err(usage(format!("--agents: there are no goals; {form}"))) };
    let mut request = v1::AssignRequest::default();
    for (key, value) in &team {
        let field = format!("--agents: {key}");
        match key.as_str() {
            "agents" => request.agents = Some(positions(key, &points(&field, value)?)?),
            "goals" => request.goals = Some(positions(key, &points(&field, value)?)?),
            "costs" => request.costs = Some(matrix(&field, value)?),
            "agent_speeds" => request.agent_speeds = of_json(&field, value)?,
            "agent_offsets" => request.agent_offsets = of_json(&field, value)?,
            "agent_loads" => request.agent_loads = of_json(&field, value)?,
            "balance" => request.balance = of_json(&field, value)?,
            "goal_weights" => request.goal_weights = of_json(&field, value)?,
            "goal_capacities" => request.goal_capacities = of_json(&field, value)?,
            "goal_earliest" => request.goal_earliest = of_json(&field, value)?,
            "goal_due" => {
                let due: Vec<Option<f64>> = of_json(&field, value)?;
                request.goal_due = due.into_iter().map(|due| due.unwrap_or(f64::INFINITY)).collect();
            }
            "precedence" => {
                let order: Vec<[u32; 2]> = of_json(&field, value)?;
                let after = |[goal_index, after_index]: [u32; 2]| v1::Precedence {
                    goal_index,
                    after_index,
                    ..Default::default()
                };
                request.precedence = order.into_iter().map(after).collect();
            }
            "pinned" => request.pinned = pairs(&field, value)?,
            "forbidden" => request.forbidden = pairs(&field, value)?,
            "current" => request.current = pairs(&field, value)?,
            "switching_cost" => request.switching_cost = of_json(&field, value)?,
            "power" => request.power = Some(of_json(&field, value)?),
            _ => return Err(usage(format!("--agents: unknown key '{key}'; `magex assign --help` lists them"))),
        }
    }
    // After the keys: an unknown one may be the missing one, misspelt.
    if !team.contains_key("costs") {
        for key in ["agents", "goals"] {
            let missing = || usage(format!("--agents: '{key}' is missing; {form}"));
            team.get(key).map(drop).ok_or_else(missing)?;
        }
    }
    Ok(request)
}

/// Parses an exponent of costs.
fn power(text: &str) -> Result<f64, String> {
    let number: Option<f64> = text.trim().parse().ok().filter(|number| POWERS.contains(number));
    number.ok_or_else(|| format!("write a number from {} to {}", POWERS.start(), POWERS.end()))
}

fn of_json<T: serde::de::DeserializeOwned>(field: &str, value: &Value) -> anyhow::Result<T> {
    serde_json::from_value(value.clone()).map_err(|error| usage(format!("{field}: {error}")))
}

fn pairs(field: &str, value: &Value) -> anyhow::Result<Vec<v1::PairRef>> {
    let list: Vec<[u32; 2]> = of_json(field, value)?;
    let pair = |[agent_index, goal_index]: [u32; 2]| v1::PairRef { agent_index, goal_index, ..Default::default() };
    Ok(list.into_iter().map(pair).collect())
}

/// Costs, one row per agent; null forbids a pair.
fn matrix(field: &str, value: &Value) -> anyhow::Result<v1::CostMatrix> {
    let rows: Vec<Vec<Option<f64>>> = of_json(field, value)?;
    let goals = rows.first().map_or(0, Vec::len);
    if let Some(place) = rows.iter().position(|row| row.len() != goals) {
        let wrong = rows[place].len();
        return Err(usage(format!("{field}[{place}]: {wrong} costs, the first row has {goals}")));
    }
    let agents = rows.len() as u32;
    let values = rows.into_iter().flatten().map(|cost| cost.unwrap_or(f64::INFINITY)).collect();
    Ok(v1::CostMatrix { agents, goals: goals as u32, values })
}

fn parse(field: &str, text: &str) -> anyhow::Result<Value> {
    serde_json::from_str(text).map_err(|error| {
        let (line, column) = (error.line(), error.column());
        usage(format!("--{field}: not valid JSON at line {line}, column {column}; give [[x, y], …]"))
    })
}

/// The points of a list; an error names the one that is wrong.
fn points(field: &str, list: &Value) -> anyhow::Result<Vec<Vec<f64>>> {
    let wrong = |place: String, what: &str, value: &Value| usage(format!("{field}{place}: {value} is not {what}"));
    let list = list.as_array().ok_or_else(|| wrong(String::new(), "a list of points; give [[x, y], …]", list))?;
    let point = |(i, point): (usize, &Value)| {
        let numbers = point.as_array().ok_or_else(|| wrong(format!("[{i}]"), "a point; give [x, y]", point))?;
        let number = |(k, value): (usize, &Value)| {
            let number = value.as_f64().filter(|number| number.is_finite());
            number.ok_or_else(|| wrong(format!("[{i}][{k}]"), "a number", value))
        };
        numbers.iter().enumerate().map(number).collect()
    };
    list.iter().enumerate().map(point).collect()
}

/// JSON as it is, a file's contents, or standard input.
fn read(field: &str, text: &str) -> anyhow::Result<String> {
    match text {
        "-" => {
            let mut all = Vec::new();
            std::io::stdin().read_to_end(&mut all).context("standard input")?;
            String::from_utf8(all).map_err(|_| usage(format!("--{field} -: standard input is not text (UTF-8)")))
        }
        _ if text.trim_start().starts_with(['[', '{']) => Ok(text.to_owned()),
        "" => Err(usage(format!("--{field}: nothing is given; give JSON or a file"))),
        path => Ok(options::text_file(&format!("--{field}"), Path::new(path))?),
    }
}

fn positions(field: &str, points: &[Vec<f64>]) -> anyhow::Result<v1::Positions> {
    // An empty side is answered, too: the members of the other one are left over.
    let dims = points.first().map_or(2, Vec::len);
    if !(2..=3).contains(&dims) {
        return Err(usage(format!("{field}: points of 2 or 3 coordinates are needed, the first has {dims}")));
    }
    if let Some(place) = points.iter().position(|point| point.len() != dims) {
        let wrong = points[place].len();
        return Err(usage(format!("{field}[{place}]: {wrong} coordinates, the first point has {dims}")));
    }
    Ok(v1::Positions { dims: dims as u32, coordinates: points.concat(), ..Default::default() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_must_agree_in_their_dimensions() {
        assert_eq!(positions("agents", &[vec![1.0, 2.0], vec![3.0, 4.0]]).unwrap().coordinates, [1.0, 2.0, 3.0, 4.0]);
        assert_eq!(positions("agents", &[]).unwrap(), v1::Positions { dims: 2, ..Default::default() });
        for (points, words) in [
            (vec![vec![]], "the first has 0"),
            (vec![vec![1.0]], "the first has 1"),
            (vec![vec![1.0, 2.0], vec![1.0]], "agents[1]: 1 coordinates"),
        ] {
            let error = positions("agents", &points).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}
