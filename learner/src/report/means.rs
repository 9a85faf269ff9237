//! Means of the episodes' metrics, and the fields that metrics.jsonl and summary.json have for them: one for each row of
//! [`METRICS`], in its order.

use magex_core::metrics_table::{METRICS, SUCCESS_RATE, as_written};
use magex_core::trajectory::EpisodeMetrics;
use serde::ser::SerializeMap as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use std::collections::BTreeMap;

/// Means over episodes, a value for each row of [`METRICS`]; `None` for a metric that the task does not have.
pub type Means = [Option<f64>; METRICS.len()];

/// Means over the episodes of an evaluation, or of an iteration's training episodes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EvalSummary {
    /// Episodes.
    pub episodes: usize,
    /// Over these episodes.
    pub means: Means,
}

/// `episodes`, then every metric under its name.
impl Serialize for EvalSummary {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("episodes", &self.episodes)?;
        for (metric, mean) in METRICS.iter().zip(self.means) {
            map.serialize_entry(metric.name, &mean.map(as_written))?;
        }
        map.end()
    }
}

/// Means in the order of the episodes; `None` if there are none. A metric that an episode does not have has no mean.
pub fn summarise<'a>(episodes: impl IntoIterator<Item = &'a EpisodeMetrics>) -> Option<EvalSummary> {
    let episodes: Vec<&EpisodeMetrics> = episodes.into_iter().collect();
    let count = episodes.len();
    let sum = |metric| episodes.iter().map(|e| e.get(metric).map(f64::from)).sum::<Option<f64>>();
    let means = std::array::from_fn(|metric| sum(metric).map(|sum| sum / count as f64));
    (count > 0).then_some(EvalSummary { episodes: count, means })
}

/// What an iteration's episodes scored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IterationMeans {
    /// Greedy evaluation of the weights that the iteration started with.
    pub greedy: Option<EvalSummary>,
    /// Training episodes with the same weights: sampled actions and goals.
    pub sampled: Option<EvalSummary>,
}

impl IterationMeans {
    /// A row of [`METRICS`] as metrics.jsonl has it under its name: greedy, unless only its sampled column is there.
    pub fn get(&self, metric: usize) -> Option<f64> {
        let source = if METRICS[metric].greedy() { &self.greedy } else { &self.sampled };
        source.and_then(|summary| summary.means[metric]).map(as_written)
    }
}

/// The greedy columns, then the sampled ones.
impl Serialize for IterationMeans {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let greedy = METRICS.iter().enumerate().filter(|(_, metric)| metric.greedy());
        let sampled = |row: usize| self.sampled.and_then(|summary| summary.means[row]).map(as_written);
        let sampled = METRICS.iter().enumerate().filter_map(|(row, metric)| Some((metric.sampled?, sampled(row))));
        serializer.collect_map(greedy.map(|(row, metric)| (metric.name, self.get(row))).chain(sampled))
    }
}

/// What the closing evaluations scored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClosingMeans {
    /// Greedy evaluation. Metrics that metrics.jsonl has of training episodes only are left out of summary.json.
    pub greedy: Means,
    /// Success rate of the sampled evaluation.
    pub sampled_success_rate: Option<f64>,
}

const SAMPLED_SUCCESS_RATE: &str = "sampled_success_rate";

impl Serialize for ClosingMeans {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        for (row, metric) in METRICS.iter().enumerate().filter(|(_, metric)| metric.greedy()) {
            map.serialize_entry(metric.name, &self.greedy[row].map(as_written))?;
            if row == SUCCESS_RATE {
                map.serialize_entry(SAMPLED_SUCCESS_RATE, &self.sampled_success_rate.map(as_written))?;
            }
        }
        map.end()
    }
}

impl<'de> Deserialize<'de> for ClosingMeans {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let values = BTreeMap::<String, Value>::deserialize(deserializer)?;
        let number = |name: &str| values.get(name).and_then(Value::as_f64);
        Ok(Self {
            greedy: std::array::from_fn(|row| number(METRICS[row].name)),
            sampled_success_rate: number(SAMPLED_SUCCESS_RATE),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::metrics_table::{REWARD, SECOND_COST_RATIO};

    /// The names and their order, which other programs read.
    #[test]
    fn metrics_of_episodes_have_their_names_and_order() {
        let mut episode = EpisodeMetrics([0.25; METRICS.len()]);
        let first = episode;
        (episode[SUCCESS_RATE], episode[SECOND_COST_RATIO]) = (0.75, f32::NAN);
        let summary = summarise([&first, &episode]).unwrap();
        assert_eq!((summary.episodes, summary.means[SUCCESS_RATE], summary.means[REWARD]), (2, Some(0.5), Some(0.25)));
        assert_eq!(summarise([]), None);
        let greedy = "\"success_rate\":0.5,\"matched_success_rate\":0.25,\"all_covered_rate\":0.25,\"arrival_step\":0.25,\
            \"collisions_per_agent_step\":0.25,\"collision_rate\":0.25,\"spawn_success_rate\":0.25,\"cost_ratio\":0.25,\
            \"second_cost_ratio\":null,\"episode_return\":0.25,\"episode_length\":0.25";
        let sampled = "\"sampled_success_rate\":null,\"sampled_collisions_per_agent_step\":null,\
            \"sampled_collision_rate\":null,\"sampled_cost_ratio\":null,\"reward\":null,\
            \"sampled_episode_return\":null,\"sampled_episode_length\":null";
        let line = serde_json::to_string(&IterationMeans { greedy: Some(summary), sampled: None }).unwrap();
        assert_eq!(line, format!("{{{greedy},{sampled}}}"));
        // Means of single-precision numbers print as such, as text and as a value.
        let thirds: Vec<EpisodeMetrics> = [0.6, 0.6, 0.87].map(|x: f32| EpisodeMetrics([x; METRICS.len()])).to_vec();
        let summary = summarise(&thirds).unwrap();
        assert_eq!(serde_json::to_value(summary).unwrap()["success_rate"].to_string(), "0.69");
        assert_eq!(IterationMeans { greedy: Some(summary), sampled: None }.get(SUCCESS_RATE), Some(0.69));
        let summary = summarise([&first, &episode]).unwrap();
        let mut closing = ClosingMeans { greedy: summary.means, sampled_success_rate: Some(0.125) };
        let line = serde_json::to_string(&closing).unwrap();
        assert_eq!(line, format!("{{{}}}", greedy.replacen(",", ",\"sampled_success_rate\":0.125,", 1)));
        closing.greedy[REWARD] = None;
        assert_eq!(serde_json::from_str::<ClosingMeans>(&line).unwrap(), closing);
    }
}
