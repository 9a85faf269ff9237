//! A replay to look at: one HTML file with everything inside, opened by a double click.
//!
//! The page computes what it shows (covered landmarks, contacts, arrival) from the recorded states and from the sizes in
//! [`ReplayInfo`], and knows no task by name; three dimensions are seen from above, from the side and in space.

use magex_core::task::{DroneConfig, Group, TaskConfig, TaskName};
use magex_core::trajectory::{EpisodeMetrics, Recording};
use serde::Serialize;
use thiserror::Error;

const PAGE: &str = include_str!("replay.html");
/// States are stored as whole multiples of this; as a length in world units, a fifth of a pixel on a map of side 2.
const UNIT: f64 = 1e-3;

/// Why a replay could not be written.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ReplayError {
    /// Nothing to show.
    #[error("episodes: there is nothing to replay; record at least one evaluation episode")]
    Empty,
    /// An array does not have the length its shape asks for, or holds something that cannot be drawn.
    #[error("episodes[{episode}].{field}: {reason}")]
    Recording {
        /// Index of the episode.
        episode: usize,
        /// Which array.
        field: &'static str,
        /// What is wrong with it.
        reason: String,
    },
}

/// What a page says and needs to know besides the states. Lengths are in world units.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayInfo {
    /// Headline, for example the run's name.
    pub title: String,
    /// One line below: task, weights, scheduler.
    pub subtitle: String,
    /// Side of the map, which is centred on the origin.
    pub side: f32,
    /// What a world unit is called, in the plural.
    pub length_unit: &'static str,
    /// What an agent is called.
    pub agent_name: &'static str,
    /// Radius of an agent.
    pub agent_radius: f32,
    /// Radius of the bodies that are not agents.
    pub ball_radius: f32,
    /// Radius a landmark is drawn with.
    pub landmark_radius: f32,
    /// Two agents closer than this are in contact.
    pub contact_distance: f32,
    /// A landmark is covered by a member of the last group but one of the chain within this distance.
    pub cover_radius: f32,
    /// Simulated seconds per step.
    pub step_seconds: f32,
    /// Height of the ground, if there is one.
    pub ground: Option<f32>,
    /// The groups from the agents to the landmarks, K + 1 of them: the k-th goal of an agent is a member of entry k + 1.
    pub chain: Vec<Group>,
    /// Which of an agent's extras begin its target velocity.
    pub target_velocity: Option<usize>,
    /// Which of an agent's extras are x and y of its upward axis; the first of the two.
    pub up: Option<usize>,
    /// Which of an agent's extras says (by 1) that it crashed: it covers nothing any more.
    pub out: Option<usize>,
}

impl ReplayInfo {
    /// The sizes of a task (paper, section 5.1).
    pub fn of(task: &TaskConfig, title: impl Into<String>, subtitle: impl Into<String>) -> Self {
        let (seen, stages) = (task.observation(), task.stages());
        let flies = task.name == TaskName::Drones;
        let (landmark_radius, step_seconds) = match task.name {
            TaskName::SimpleSpread => (0.05, 0.1),
            TaskName::PushBall => (0.15, 0.1),
            TaskName::Drones => (0.03, 1.0 / DroneConfig::COMMANDS_HZ as f32),
        };
        Self {
            title: title.into(),
            subtitle: subtitle.into(),
            side: task.side,
            length_unit: if flies { "metres" } else { "world units" },
            agent_name: if flies { "drone" } else { "agent" },
            agent_radius: seen.contact / 2.0,
            ball_radius: 0.15,
            landmark_radius,
            contact_distance: seen.contact,
            cover_radius: seen.reached,
            step_seconds,
            ground: flies.then_some(0.0),
            chain: stages.iter().take(1).map(|stage| stage.from).chain(stages.iter().map(|stage| stage.to)).collect(),
            target_velocity: flies.then_some(0),
            up: flies.then_some(3),
            out: seen.out,
        }
    }

    /// How many of an agent's extras the page reads.
    fn extras(&self) -> usize {
        let ends = [self.target_velocity.map(|x| x + 3), self.up.map(|x| x + 2), self.out.map(|x| x + 1)];
        ends.into_iter().flatten().max().unwrap_or(0)
    }
}

/// One episode of a page.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayEpisode<'a> {
    /// Its name in the list, for example `episode 3`.
    pub name: String,
    /// The states.
    pub recording: &'a Recording,
    /// What it scored, if that is known; shown beside the numbers the page computes.
    pub metrics: Option<EpisodeMetrics>,
}

/// What the page's script reads.
#[derive(Serialize)]
struct Page<'a> {
    title: &'a str,
    subtitle: &'a str,
    unit: f64,
    side: f32,
    length_unit: &'a str,
    agent_name: &'a str,
    out_name: &'a str,
    agent_radius: f32,
    ball_radius: f32,
    landmark_radius: f32,
    contact_distance: f32,
    cover_radius: f32,
    step_seconds: f32,
    ground: Option<f32>,
    chain: Vec<&'static str>,
    target_velocity: Option<usize>,
    up: Option<usize>,
    out: Option<usize>,
    episodes: Vec<PageEpisode<'a>>,
}

#[derive(Serialize)]
struct PageEpisode<'a> {
    name: &'a str,
    steps: usize,
    agents: usize,
    bodies: usize,
    landmarks: usize,
    dims: usize,
    extras: usize,
    targets: usize,
    /// 32-bit instead of 16-bit numbers.
    wide: bool,
    /// `[T+1, E, D]`, base64 of little-endian whole multiples of the unit.
    positions: String,
    /// `[T+1, N, X]`, the same.
    extra_values: String,
    /// `[G, D]`, the same.
    landmarks_at: String,
    /// `[N, K]`
    goals: &'a [u32],
    facts: Vec<(&'static str, String)>,
}

/// The page, ready to be written to a file.
///
/// # Errors
/// No episodes, and recordings whose arrays do not fit their shape or the task, or are not finite.
pub fn replay_html(info: &ReplayInfo, episodes: &[ReplayEpisode<'_>]) -> Result<String, ReplayError> {
    if episodes.is_empty() {
        return Err(ReplayError::Empty);
    }
    let pages: Result<Vec<_>, _> =
        episodes.iter().enumerate().map(|(k, episode)| page_episode(info, k, episode)).collect();
    let page = Page {
        title: &info.title,
        subtitle: &info.subtitle,
        unit: UNIT,
        side: info.side,
        length_unit: info.length_unit,
        agent_name: info.agent_name,
        out_name: "crashed",
        agent_radius: info.agent_radius,
        ball_radius: info.ball_radius,
        landmark_radius: info.landmark_radius,
        contact_distance: info.contact_distance,
        cover_radius: info.cover_radius,
        step_seconds: info.step_seconds,
        ground: info.ground,
        chain: info.chain.iter().map(|&group| group_name(group)).collect(),
        target_velocity: info.target_velocity,
        up: info.up,
        out: info.out,
        episodes: pages?,
    };
    let data = serde_json::to_string(&page).map_err(|error| ReplayError::Recording {
        episode: 0,
        field: "page",
        reason: error.to_string(),
    })?;
    // The data comes last: nothing is replaced inside it. A `<` could end the script element early.
    let title = info.title.replace('&', "&amp;").replace('<', "&lt;");
    let (head, tail) = PAGE.split_once("@DATA@").unwrap_or((PAGE, ""));
    Ok([&head.replace("@TITLE@", &title), &data.replace('<', "\\u003c"), tail].concat())
}

/// What the page calls a group.
fn group_name(group: Group) -> &'static str {
    match group {
        Group::Agents => "agents",
        Group::Balls => "balls",
        Group::Landmarks => "landmarks",
    }
}

fn page_episode<'a>(
    info: &ReplayInfo,
    index: usize,
    episode: &'a ReplayEpisode<'_>,
) -> Result<PageEpisode<'a>, ReplayError> {
    let recording = episode.recording;
    let shape = &recording.shape;
    let wrong = |field, reason| ReplayError::Recording { episode: index, field, reason };
    if shape.agents == 0 || shape.dims == 0 || shape.targets == 0 || shape.bodies < shape.agents {
        return Err(wrong("shape", "agents, dims and targets must be at least 1 and bodies as many as agents".into()));
    }
    if shape.targets + 1 != info.chain.len() {
        let expected = info.chain.len().saturating_sub(1);
        return Err(wrong("shape", format!("targets is {}, the task assigns {expected} to an agent", shape.targets)));
    }
    if shape.extras < info.extras() {
        return Err(wrong("shape", format!("extras is {}, the task has {} or more", shape.extras, info.extras())));
    }
    let floats = [
        ("positions", &recording.positions, (shape.steps + 1) * shape.bodies * shape.dims),
        ("extras", &recording.extras, (shape.steps + 1) * shape.agents * shape.extras),
        ("landmarks", &recording.landmarks, shape.landmarks * shape.dims),
    ];
    let mut wide = false;
    for (field, values, expected) in floats {
        if values.len() != expected {
            return Err(wrong(field, format!("{} numbers, the shape asks for {expected}", values.len())));
        }
        if let Some(place) = values.iter().position(|x| x.is_nan() || x.abs() > 2e6) {
            return Err(wrong(field, format!("entry {place} is {}, which cannot be drawn", values[place])));
        }
        wide |= values.iter().any(|&x| quantised(x).abs() > i32::from(i16::MAX));
    }
    if recording.goals.len() != shape.agents * shape.targets {
        let expected = shape.agents * shape.targets;
        return Err(wrong("goals", format!("{} entries, the shape asks for {expected}", recording.goals.len())));
    }
    for (place, &goal) in recording.goals.iter().enumerate() {
        let group = info.chain[place % shape.targets + 1];
        let members = match group {
            Group::Agents => shape.agents,
            Group::Balls => shape.bodies - shape.agents,
            Group::Landmarks => shape.landmarks,
        };
        if goal as usize >= members {
            let reason = format!("entry {place} is {goal}, there are {members} {}", group_name(group));
            return Err(wrong("goals", reason));
        }
    }
    Ok(PageEpisode {
        name: &episode.name,
        steps: shape.steps,
        agents: shape.agents,
        bodies: shape.bodies,
        landmarks: shape.landmarks,
        dims: shape.dims,
        extras: shape.extras,
        targets: shape.targets,
        wide,
        positions: pack(&recording.positions, wide),
        extra_values: pack(&recording.extras, wide),
        landmarks_at: pack(&recording.landmarks, wide),
        goals: &recording.goals,
        facts: episode.metrics.map(|metrics| facts(info, &metrics)).unwrap_or_default(),
    })
}

fn facts(info: &ReplayInfo, metrics: &EpisodeMetrics) -> Vec<(&'static str, String)> {
    let known = [
        ("success at the start", Some(metrics.spawn_success)),
        ("success at the end", Some(metrics.success)),
        ("matched success", Some(metrics.matched_success)),
        ("collision rate", info.out.map(|_| metrics.collision_rate)),
        ("assignment cost ratio", Some(metrics.cost_ratio)),
        ("second cost ratio", metrics.second_cost_ratio),
        ("mean reward", Some(metrics.reward)),
    ];
    known.into_iter().filter_map(|(name, value)| value.map(|value| (name, format!("{value:.3}")))).collect()
}

fn quantised(value: f32) -> i32 {
    (f64::from(value) / UNIT).round() as i32
}

fn pack(values: &[f32], wide: bool) -> String {
    let bytes: Vec<u8> = if wide {
        values.iter().flat_map(|&x| quantised(x).to_le_bytes()).collect()
    } else {
        values.iter().flat_map(|&x| (quantised(x) as i16).to_le_bytes()).collect()
    };
    base64(&bytes)
}

/// RFC 4648, with padding.
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let byte = |k: usize| u32::from(group.get(k).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for digit in 0..4 {
            if digit <= group.len() {
                text.push(char::from(DIGITS[(bits >> (18 - 6 * digit)) as usize & 63]));
            } else {
                text.push('=');
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::task::Spawn;
    use magex_core::trajectory::Shape;

    fn recording() -> Recording {
        Recording {
            shape: Shape {
                steps: 1,
                episodes: 1,
                agents: 2,
                bodies: 2,
                landmarks: 2,
                dims: 2,
                extras: 0,
                targets: 1,
                heads: 1,
            },
            positions: vec![0.0, 0.0, 1.0, 1.0, 0.1, 0.0, 1.0, 0.9],
            extras: vec![],
            landmarks: vec![0.5, 0.0, 1.0, 0.0],
            goals: vec![0, 1],
        }
    }

    /// Two agents, each with a ball of its own.
    fn with_balls() -> Recording {
        let mut recording = recording();
        (recording.shape.bodies, recording.shape.targets) = (4, 2);
        recording.positions = (0..16).map(|k| 0.1 * k as f32).collect();
        recording.goals = vec![1, 0, 0, 1];
        recording
    }

    /// Two drones, of which the second is out at the end.
    fn in_space() -> Recording {
        let mut recording = recording();
        (recording.shape.dims, recording.shape.extras, recording.shape.heads) = (3, 6, 3);
        recording.positions = (0..12).map(|k| 0.1 * k as f32).collect();
        recording.landmarks = vec![0.5, 0.0, 1.5, 1.0, 0.0, 1.5];
        recording.extras = vec![0.0; 24];
        recording.extras[0] = -1.5;
        recording.extras[23] = 1.0;
        recording
    }

    fn info(name: TaskName, title: &str) -> ReplayInfo {
        ReplayInfo::of(&TaskConfig::of(name, 5, Spawn::Uniform), title, "N = 2")
    }

    fn page_of(name: TaskName, title: &str, recording: &Recording) -> Result<String, ReplayError> {
        replay_html(&info(name, title), &[ReplayEpisode { name: "episode 0".into(), recording, metrics: None }])
    }

    fn page(title: &str, recording: &Recording) -> Result<String, ReplayError> {
        page_of(TaskName::SimpleSpread, title, recording)
    }

    /// The data of a page as the script reads it.
    fn data(html: &str) -> serde_json::Value {
        let (_, rest) = html.split_once("id=\"data\">").unwrap();
        serde_json::from_str(rest.split_once("</script>").unwrap().0).unwrap()
    }

    #[test]
    fn base64_of_the_standard() {
        for (plain, text) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(base64(plain.as_bytes()), text);
        }
    }

    #[test]
    fn the_page_is_self_contained_and_keeps_its_text_inert() {
        let html = page("</script><b>&", &recording()).unwrap();
        assert!(html.contains("<title>&lt;/script>&lt;b>&amp;</title>"));
        assert!(html.contains("\\u003c/script>"));
        assert_eq!(html.matches("</script>").count(), 2, "the page's own");
        assert!(!html.contains("http://") && !html.contains("https://") && !html.contains("@DATA@"));
        assert!(html.contains(&pack(&recording().positions, false)));
    }

    #[test]
    fn far_away_positions_use_wide_numbers() {
        let mut far = recording();
        far.positions[0] = -40.0;
        assert!(page("far", &far).unwrap().contains("\"wide\":true"));
        assert_eq!(quantised(-40.0), -40_000);
        assert_eq!(quantised(0.0015), 2);
    }

    #[test]
    fn what_cannot_be_drawn_is_refused_by_name() {
        let refuse = |change: fn(&mut Recording)| {
            let mut bad = recording();
            change(&mut bad);
            page("bad", &bad).unwrap_err().to_string()
        };
        assert!(refuse(|r| r.positions[3] = f32::NAN).starts_with("episodes[0].positions: entry 3 is NaN"));
        assert!(refuse(|r| r.landmarks.truncate(3)).starts_with("episodes[0].landmarks: 3 numbers"));
        assert!(refuse(|r| r.goals.push(0)).starts_with("episodes[0].goals: 3 entries"));
        assert!(refuse(|r| r.shape.bodies = 1).starts_with("episodes[0].shape"));
        assert!(refuse(|r| r.goals[1] = 2).ends_with("goals: entry 1 is 2, there are 2 landmarks"));
        assert!(refuse(|r| r.extras.push(0.0)).starts_with("episodes[0].extras: 1 numbers, the shape asks for 0"));
        assert_eq!(replay_html(&info(TaskName::SimpleSpread, "none"), &[]), Err(ReplayError::Empty));
    }

    #[test]
    fn extras_are_packed_and_checked_like_positions() {
        let recording = in_space();
        let data = data(&page_of(TaskName::Drones, "drones", &recording).unwrap());
        let episode = &data["episodes"][0];
        assert_eq!(episode["extras"], 6);
        assert_eq!(episode["extra_values"], pack(&recording.extras, false).as_str());
        // Two bytes a number, three bytes in four digits: -1500 and 0 first, 0 and 1000 last.
        let text = episode["extra_values"].as_str().unwrap();
        assert_eq!(text.len(), 24 * 2 / 3 * 4);
        assert!(text.starts_with(&base64(&[0x24, 0xfa, 0])) && text.ends_with(&base64(&[0, 0xe8, 0x03])));

        let refuse = |change: fn(&mut Recording)| {
            let mut bad = in_space();
            change(&mut bad);
            page_of(TaskName::Drones, "bad", &bad).unwrap_err().to_string()
        };
        assert!(refuse(|r| r.extras.truncate(23)).starts_with("episodes[0].extras: 23 numbers, the shape asks for 24"));
        assert!(refuse(|r| r.extras[7] = f32::NAN).starts_with("episodes[0].extras: entry 7 is NaN"));
        assert!(refuse(|r| r.extras[8] = f32::INFINITY).starts_with("episodes[0].extras: entry 8 is inf"));
        assert!(refuse(|r| r.shape.extras = 5).starts_with("episodes[0].shape: extras is 5"));
    }

    #[test]
    fn goals_follow_the_chain_of_the_task() {
        let fits = data(&page_of(TaskName::PushBall, "balls", &with_balls()).unwrap());
        assert_eq!(fits["chain"], serde_json::json!(["agents", "balls", "landmarks"]));
        assert_eq!(fits["episodes"][0]["goals"], serde_json::json!([1, 0, 0, 1]));
        let refuse = |change: fn(&mut Recording)| {
            let mut bad = with_balls();
            change(&mut bad);
            page_of(TaskName::PushBall, "bad", &bad).unwrap_err().to_string()
        };
        assert!(refuse(|r| r.goals[2] = 3).ends_with("goals: entry 2 is 3, there are 2 balls"));
        assert!(refuse(|r| r.goals[3] = 2).ends_with("goals: entry 3 is 2, there are 2 landmarks"));
        let spread = page("bad", &with_balls()).unwrap_err().to_string();
        assert!(spread.starts_with("episodes[0].shape: targets is 2, the task assigns 1"), "{spread}");
    }

    #[test]
    fn each_task_brings_its_own_sizes() {
        let sizes = |name| {
            let info = info(name, "");
            (info.agent_radius, info.landmark_radius, info.contact_distance, info.cover_radius, info.step_seconds)
        };
        assert_eq!(sizes(TaskName::SimpleSpread), (0.1, 0.05, 0.2, 0.15, 0.1));
        assert_eq!(sizes(TaskName::PushBall), (0.1, 0.15, 0.2, 0.3, 0.1));
        assert_eq!(sizes(TaskName::Drones), (0.06, 0.03, 0.12, 0.15, 1.0 / 30.0));
        for name in [TaskName::SimpleSpread, TaskName::PushBall, TaskName::Drones] {
            let (task, info) = (TaskConfig::of(name, 5, Spawn::Uniform), info(name, ""));
            assert_eq!(info.chain.len(), task.stages().len() + 1, "{name}");
            assert_eq!((info.extras(), info.side), (task.extras(), task.side), "{name}");
        }
    }

    #[test]
    fn facts_that_a_task_does_not_have_are_left_out() {
        let mut metrics = EpisodeMetrics {
            success: 0.75,
            matched_success: 0.5,
            spawn_success: 0.125,
            arrival_step: 61,
            collisions_per_agent_step: 0.0,
            collision_rate: 0.25,
            reward: 0.5,
            cost_ratio: 1.0,
            second_cost_ratio: None,
        };
        let value = |name, metrics: &EpisodeMetrics, fact: &str| {
            facts(&info(name, ""), metrics).into_iter().find(|(key, _)| *key == fact).map(|(_, value)| value)
        };
        assert_eq!(value(TaskName::SimpleSpread, &metrics, "success at the start").as_deref(), Some("0.125"));
        assert_eq!(value(TaskName::SimpleSpread, &metrics, "collision rate"), None);
        assert_eq!(value(TaskName::SimpleSpread, &metrics, "second cost ratio"), None);
        assert_eq!(value(TaskName::Drones, &metrics, "collision rate").as_deref(), Some("0.250"));
        metrics.second_cost_ratio = Some(1.25);
        assert_eq!(value(TaskName::PushBall, &metrics, "second cost ratio").as_deref(), Some("1.250"));
    }
}
