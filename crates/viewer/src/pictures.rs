//! A replay of an environment that draws itself: its pictures, in one self-contained HTML file.

use magex_core::error::FieldError;
use magex_core::metrics_table::METRICS;
use magex_core::trajectory::{EpisodeMetrics, Recording};
use serde::Serialize;

const PAGE: &str = include_str!("pictures.html");

#[derive(Serialize)]
struct Page<'a> {
    title: &'a str,
    subtitle: &'a str,
    episodes: Vec<Episode<'a>>,
}

#[derive(Serialize)]
struct Episode<'a> {
    /// PNG files in base64.
    pictures: &'a [String],
    /// What it scored, in words.
    scores: String,
}

/// The page of the pictures of some episodes, and of their scores if these are known. It refuses episodes without pictures.
pub fn pictures_html(
    title: &str,
    subtitle: &str,
    episodes: &[(Recording, Option<EpisodeMetrics>)],
) -> Result<String, FieldError> {
    if let Some(index) = episodes.iter().position(|(recording, _)| recording.pictures.is_empty()) {
        let problem =
            "the environment draws no pictures; make it with render_mode=\"rgb_array\" and train or replay anew";
        return Err(FieldError::new(format!("episodes[{index}].pictures"), problem));
    }
    let scores = |metrics: &EpisodeMetrics| {
        let known = METRICS.iter().enumerate().filter_map(|(row, metric)| Some((metric, metrics.get(row)?)));
        known.map(|(metric, value)| format!("{} {}", metric.label, metric.write(value.into()))).collect::<Vec<_>>()
    };
    let scores = |metrics: &Option<EpisodeMetrics>| metrics.as_ref().map(scores).unwrap_or_default().join(" · ");
    let rows = episodes.iter();
    let episodes = rows.map(|(recording, m)| Episode { pictures: &recording.pictures, scores: scores(m) }).collect();
    let data = serde_json::to_string(&Page { title, subtitle, episodes });
    let data = data.map_err(|error| FieldError::new("page", error.to_string()))?;
    let title = title.replace('&', "&amp;").replace('<', "&lt;");
    Ok(PAGE.replace("@TITLE@", &title).replacen("@DATA@", &data.replace('<', "\\u003c"), 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recording(pictures: &[&str]) -> Recording {
        Recording {
            shape: Default::default(),
            positions: Vec::new(),
            agent_state: Vec::new(),
            statics: Default::default(),
            goals: Vec::new(),
            pictures: pictures.iter().map(|&picture| picture.to_owned()).collect(),
        }
    }

    #[test]
    fn a_page_has_every_picture_and_no_markup_of_a_name() {
        let page = pictures_html("a </script>", "b", &[(recording(&["aa", "bb"]), None)]).unwrap();
        assert!(page.contains("\"aa\",\"bb\"") && !page.contains("a </script>") && !page.contains('@'), "{page}");
        let error = pictures_html("a", "b", &[(recording(&[]), None)]).unwrap_err().to_string();
        assert!(error.starts_with("episodes[0].pictures: ") && error.contains("rgb_array"), "{error}");
    }
}
