//! A replay to look at: one HTML file with everything inside, opened by a double click.
//!
//! The page computes what it shows (covered landmarks, contacts, arrival) from the positions, so it works for any task
//! that records them; more than two dimensions are seen from above.

use magex_core::trajectory::{EpisodeMetrics, Recording};
use serde::Serialize;
use thiserror::Error;

const PAGE: &str = include_str!("replay.html");
/// Positions are stored as whole multiples of this, in world units: a fifth of a pixel on a map of side 2.
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

/// What a page says and needs to know besides the positions. Lengths are in world units.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayInfo {
    /// Headline, for example the run's name.
    pub title: String,
    /// One line below: task, weights, scheduler.
    pub subtitle: String,
    /// Side of the map, which is centred on the origin.
    pub side: f32,
    /// Radius of an agent; two agents closer than twice this are in contact.
    pub agent_radius: f32,
    /// Radius a landmark is drawn with.
    pub landmark_radius: f32,
    /// A landmark is covered by an agent within this distance.
    pub cover_radius: f32,
    /// Simulated seconds per step.
    pub step_seconds: f32,
}

impl ReplayInfo {
    /// The sizes of Simple Spread (paper, section 5.1.1) for a map of this side.
    pub fn simple_spread(title: impl Into<String>, subtitle: impl Into<String>, side: f32) -> Self {
        Self {
            title: title.into(),
            subtitle: subtitle.into(),
            side,
            agent_radius: 0.1,
            landmark_radius: 0.05,
            cover_radius: 0.15,
            step_seconds: 0.1,
        }
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
    agent_radius: f32,
    landmark_radius: f32,
    cover_radius: f32,
    step_seconds: f32,
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
    targets: usize,
    /// 32-bit instead of 16-bit numbers.
    wide: bool,
    /// `[T+1, E, D]`, base64 of little-endian whole multiples of the unit.
    positions: String,
    /// `[G, D]`, the same.
    landmarks_at: String,
    goals: &'a [u32],
    facts: Vec<(&'static str, String)>,
}

/// The page, ready to be written to a file.
///
/// # Errors
/// No episodes, and recordings whose arrays do not fit their shape or are not finite.
pub fn replay_html(info: &ReplayInfo, episodes: &[ReplayEpisode<'_>]) -> Result<String, ReplayError> {
    if episodes.is_empty() {
        return Err(ReplayError::Empty);
    }
    let pages: Result<Vec<_>, _> = episodes.iter().enumerate().map(|(k, episode)| page_episode(k, episode)).collect();
    let page = Page {
        title: &info.title,
        subtitle: &info.subtitle,
        unit: UNIT,
        side: info.side,
        agent_radius: info.agent_radius,
        landmark_radius: info.landmark_radius,
        cover_radius: info.cover_radius,
        step_seconds: info.step_seconds,
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

fn page_episode<'a>(index: usize, episode: &'a ReplayEpisode<'_>) -> Result<PageEpisode<'a>, ReplayError> {
    let recording = episode.recording;
    let shape = &recording.shape;
    let wrong = |field, reason| ReplayError::Recording { episode: index, field, reason };
    if shape.agents == 0 || shape.dims == 0 || shape.targets == 0 || shape.bodies < shape.agents {
        return Err(wrong("shape", "agents, dims and targets must be at least 1 and bodies as many as agents".into()));
    }
    let floats = [
        ("positions", &recording.positions, (shape.steps + 1) * shape.bodies * shape.dims),
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
    Ok(PageEpisode {
        name: &episode.name,
        steps: shape.steps,
        agents: shape.agents,
        bodies: shape.bodies,
        landmarks: shape.landmarks,
        dims: shape.dims,
        targets: shape.targets,
        wide,
        positions: pack(&recording.positions, wide),
        landmarks_at: pack(&recording.landmarks, wide),
        goals: &recording.goals,
        facts: episode.metrics.map(|metrics| facts(&metrics)).unwrap_or_default(),
    })
}

fn facts(metrics: &EpisodeMetrics) -> Vec<(&'static str, String)> {
    vec![
        ("success at the end", format!("{:.3}", metrics.success)),
        ("matched success", format!("{:.3}", metrics.matched_success)),
        ("assignment cost ratio", format!("{:.3}", metrics.cost_ratio)),
        ("mean reward", format!("{:.3}", metrics.reward)),
    ]
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

    fn page(title: &str, recording: &Recording) -> Result<String, ReplayError> {
        let info = ReplayInfo::simple_spread(title, "N = 2", 2.0);
        replay_html(&info, &[ReplayEpisode { name: "episode 0".into(), recording, metrics: None }])
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
        let info = ReplayInfo::simple_spread("none", "", 2.0);
        assert_eq!(replay_html(&info, &[]), Err(ReplayError::Empty));
    }
}
