//! A replay: one self-contained HTML file. It draws a [`Scene`], like the episode on the live page.

use crate::scene::{PackedEpisode, SCRIPT, Scene};
use magex_core::error::FieldError;
use magex_core::task::TaskConfig;
use magex_core::trajectory::{EpisodeMetrics, Recording};
use serde::Serialize;

const PAGE: &str = include_str!("replay.html");

/// The data that the script of the page reads.
#[derive(Serialize)]
struct Page<'a> {
    title: &'a str,
    subtitle: &'a str,
    #[serde(flatten)]
    scene: &'a Scene,
    episodes: Vec<PackedEpisode<'a>>,
}

/// The page of a task's episodes, and of their scores if these are known. It refuses no episodes, and recordings whose
/// arrays do not fit their shape or the task, or are not finite.
pub fn replay_html(
    task: &TaskConfig,
    title: &str,
    subtitle: &str,
    episodes: &[(Recording, Option<EpisodeMetrics>)],
) -> Result<String, FieldError> {
    if episodes.is_empty() {
        return Err(FieldError::new("episodes", "there is nothing to replay; record at least one evaluation episode"));
    }
    let scene = &Scene::of(task);
    let packed = episodes.iter().enumerate().map(|(index, (recording, metrics))| {
        let packed = scene.pack(format!("episode {}", index + 1), recording, metrics.as_ref());
        packed.map_err(|error| error.within(&format!("episodes[{index}]")))
    });
    let page = Page { title, subtitle, scene, episodes: packed.collect::<Result<_, _>>()? };
    let data = serde_json::to_string(&page).map_err(|error| FieldError::new("page", error.to_string()))?;
    // Placeholders are replaced outside the data only. A `<` in the data could end the script element early.
    let title = title.replace('&', "&amp;").replace('<', "&lt;");
    let (head, tail) = PAGE.split_once("@DATA@").unwrap_or((PAGE, ""));
    let tail = tail.replacen("@SCENE@", SCRIPT, 1);
    Ok([head.replace("@TITLE@", &title), data.replace('<', "\\u003c"), tail].concat())
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::statics::Statics;
    use magex_core::task::{Spawn, TaskName};
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
                agent_state: 0,
                goals_per_agent: 1,
                action_components: 1,
                ..Shape::default()
            },
            positions: vec![0.0, 0.0, 1.0, 1.0, 0.1, 0.0, 1.0, 0.9],
            agent_state: vec![],
            statics: Statics::landmarks(2, 2, vec![0.5, 0.0, 1.0, 0.0]),
            pictures: Vec::new(),
            goals: vec![0, 1],
        }
    }

    /// Two agents, each with a ball of its own.
    fn with_balls() -> Recording {
        let mut recording = recording();
        (recording.shape.bodies, recording.shape.goals_per_agent) = (4, 2);
        recording.positions = (0..16).map(|k| 0.1 * k as f32).collect();
        recording.goals = vec![1, 0, 0, 1];
        recording
    }

    /// Two drones, of which the second is out at the end.
    fn in_space() -> Recording {
        let mut recording = recording();
        (recording.shape.dims, recording.shape.agent_state, recording.shape.action_components) = (3, 6, 3);
        recording.positions = (0..12).map(|k| 0.1 * k as f32).collect();
        recording.statics = Statics::landmarks(2, 3, vec![0.5, 0.0, 1.5, 1.0, 0.0, 1.5]);
        recording.agent_state = vec![0.0; 24];
        recording.agent_state[0] = -1.5;
        recording.agent_state[23] = 1.0;
        recording
    }

    fn page_of(name: TaskName, title: &str, recording: &Recording) -> Result<String, FieldError> {
        replay_html(&TaskConfig::of(name, 5, Spawn::Uniform), title, "N = 2", &[(recording.clone(), None)])
    }

    fn page(title: &str, recording: &Recording) -> Result<String, FieldError> {
        page_of(TaskName::SimpleSpread, title, recording)
    }

    /// The data of a page as the script reads it.
    fn data(html: &str) -> serde_json::Value {
        let (_, rest) = html.split_once("id=\"data\">").unwrap();
        serde_json::from_str(rest.split_once("</script>").unwrap().0).unwrap()
    }

    #[test]
    fn the_page_is_self_contained_and_keeps_its_text_inert() {
        let html = page("</script><b>&", &recording()).unwrap();
        assert!(html.contains("<title>&lt;/script>&lt;b>&amp;</title>"));
        assert!(html.contains("\\u003c/script>"));
        assert_eq!(html.matches("</script>").count(), 2, "the page's own");
        assert!(!html.contains("http://") && !html.contains("https://") && !html.contains("@DATA@"));
        assert!(!html.contains("@SCENE@") && html.contains("function makeScene"));
        assert!(html.contains("\"positions\":\"AAAAAOgD6ANkAAAA6AOEAw==\""));
    }

    #[test]
    fn far_away_positions_use_wide_numbers() {
        let mut far = recording();
        far.positions[0] = -40.0;
        assert!(page("far", &far).unwrap().contains("\"wide\":true"));
    }

    #[test]
    fn recordings_that_cannot_be_drawn_are_rejected_by_field() {
        let refuse = |change: fn(&mut Recording)| {
            let mut bad = recording();
            change(&mut bad);
            page("bad", &bad).unwrap_err().to_string()
        };
        assert!(refuse(|r| r.positions[3] = f32::NAN).starts_with("episodes[0].positions: entry 3 is NaN"));
        assert!(refuse(|r| r.statics.0[0].values.truncate(3)).starts_with("episodes[0].landmarks: 3 numbers"));
        assert!(refuse(|r| r.goals.push(0)).starts_with("episodes[0].goals: 3 entries"));
        assert!(refuse(|r| r.shape.bodies = 1).starts_with("episodes[0].shape"));
        assert!(refuse(|r| r.goals[1] = 2).ends_with("goals: entry 1 is 2, there are 2 landmarks"));
        assert!(
            refuse(|r| r.agent_state.push(0.0)).starts_with("episodes[0].agent_state: 1 numbers, the shape asks for 0")
        );
        let task = TaskConfig::of(TaskName::SimpleSpread, 5, Spawn::Uniform);
        assert!(replay_html(&task, "none", "", &[]).unwrap_err().to_string().starts_with("episodes: there is nothing"));
    }

    #[test]
    fn agent_state_is_packed_and_checked_like_positions() {
        let recording = in_space();
        let data = data(&page_of(TaskName::Drones, "drones", &recording).unwrap());
        let episode = &data["episodes"][0];
        assert_eq!(episode["agent_state"], 6);
        // Two bytes a number, three bytes in four digits: -1500 and 0 first, 0 and 1000 last.
        let text = episode["agent_state_values"].as_str().unwrap();
        assert_eq!(text.len(), 24 * 2 / 3 * 4);
        assert!(text.starts_with("JPoA") && text.ends_with("AOgD"), "{text}");

        let refuse = |change: fn(&mut Recording)| {
            let mut bad = in_space();
            change(&mut bad);
            page_of(TaskName::Drones, "bad", &bad).unwrap_err().to_string()
        };
        assert!(
            refuse(|r| r.agent_state.truncate(23))
                .starts_with("episodes[0].agent_state: 23 numbers, the shape asks for 24")
        );
        assert!(refuse(|r| r.agent_state[7] = f32::NAN).starts_with("episodes[0].agent_state: entry 7 is NaN"));
        assert!(refuse(|r| r.agent_state[8] = f32::INFINITY).starts_with("episodes[0].agent_state: entry 8 is inf"));
        assert!(refuse(|r| r.shape.agent_state = 5).starts_with("episodes[0].shape: agent_state is 5"));
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
        assert!(spread.starts_with("episodes[0].shape: goals_per_agent is 2, the task assigns 1"), "{spread}");
    }
}
