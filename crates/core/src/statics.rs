//! Static arrays of an episode: set at its start, constant until its end, known by name.
//!
//! Every task has "landmarks" [G, D]. A task with more (obstacles, say) lists them in its definition; rollout, wire, learner
//! and validation carry whatever is listed.

use crate::error::{FieldError, check_count, check_finite};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Name of the landmarks' positions [G, D], world units.
pub const LANDMARKS: &str = "landmarks";

/// Name and shape of a static array, per episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StaticSpec {
    /// Name, unique within a task.
    pub name: &'static str,
    /// Shape of one episode's array.
    pub shape: Vec<usize>,
}

/// One static array of B episodes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StaticArray {
    /// Name.
    pub name: String,
    /// Shape of one episode's array.
    pub shape: Vec<usize>,
    /// [B, shape...], row-major.
    pub values: Vec<f32>,
}

impl StaticArray {
    /// Numbers per episode.
    fn width(&self) -> usize {
        self.shape.iter().product()
    }
}

/// The static arrays of B episodes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Statics(pub Vec<StaticArray>);

impl Statics {
    /// Landmarks `values` [B, count, dims] and nothing else.
    pub fn landmarks(count: usize, dims: usize, values: Vec<f32>) -> Self {
        Self(vec![StaticArray { name: LANDMARKS.to_owned(), shape: vec![count, dims], values }])
    }

    /// The array of a name, [B, shape...]; empty if there is none.
    pub fn get(&self, name: &str) -> &[f32] {
        self.0.iter().find(|array| array.name == name).map_or(&[], |array| &array.values)
    }

    /// All episodes.
    pub fn view(&self) -> StaticsView<'_> {
        StaticsView { arrays: &self.0, episodes: None }
    }

    /// The episode b.
    pub fn episode(&self, b: usize) -> StaticsView<'_> {
        self.episodes(b..b + 1)
    }

    /// Some consecutive episodes.
    pub fn episodes(&self, range: Range<usize>) -> StaticsView<'_> {
        StaticsView { arrays: &self.0, episodes: Some((range.start, range.end)) }
    }

    /// Checks names, shapes and lengths against those of a task, and every number for finiteness.
    pub fn validate(&self, specs: &[StaticSpec], episodes: usize) -> Result<(), FieldError> {
        if !self.0.iter().map(|array| array.name.as_str()).eq(specs.iter().map(|spec| spec.name)) {
            let names: Vec<&str> = specs.iter().map(|spec| spec.name).collect();
            return Err(FieldError::new("statics", format!("must be {} in this order", names.join(", "))));
        }
        for (array, spec) in self.0.iter().zip(specs) {
            if array.shape != spec.shape {
                let problem = format!("shape {:?} where {:?} is expected", array.shape, spec.shape);
                return Err(FieldError::new(spec.name, problem));
            }
            check_array(array, episodes)?;
        }
        Ok(())
    }

    /// Checks every length against the array's own shape, and every number for finiteness.
    pub(crate) fn check_numbers(&self, episodes: usize) -> Result<(), FieldError> {
        self.0.iter().try_for_each(|array| check_array(array, episodes))
    }
}

fn check_array(array: &StaticArray, episodes: usize) -> Result<(), FieldError> {
    check_count(&array.name, "numbers", array.values.len(), episodes * array.width())?;
    check_finite(&array.name, &array.values)
}

/// The static arrays of some consecutive episodes, borrowed.
#[derive(Debug, Clone, Copy, Default)]
pub struct StaticsView<'a> {
    arrays: &'a [StaticArray],
    /// First episode and the one after the last; `None` is all of them.
    episodes: Option<(usize, usize)>,
}

impl<'a> StaticsView<'a> {
    /// The array of a name, [Q, shape...]; empty if there is none.
    pub fn get(&self, name: &str) -> &'a [f32] {
        let Some(array) = self.arrays.iter().find(|array| array.name == name) else { return &[] };
        array.values.get(self.range(array)).unwrap_or_default()
    }

    /// A copy that owns its arrays.
    pub fn to_owned(&self) -> Statics {
        let copy = |array: &StaticArray| StaticArray {
            name: array.name.clone(),
            shape: array.shape.clone(),
            values: array.values.get(self.range(array)).unwrap_or_default().to_vec(),
        };
        Statics(self.arrays.iter().map(copy).collect())
    }

    fn range(&self, array: &StaticArray) -> Range<usize> {
        match self.episodes {
            Some((first, end)) => first * array.width()..end * array.width(),
            None => 0..array.values.len(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn statics() -> Statics {
        let obstacles = StaticArray { name: "obstacles".into(), shape: vec![1, 3], values: vec![7.0; 6] };
        let mut statics = Statics::landmarks(2, 2, (0..8).map(|x| x as f32).collect());
        statics.0.push(obstacles);
        statics
    }

    fn specs() -> [StaticSpec; 2] {
        [StaticSpec { name: LANDMARKS, shape: vec![2, 2] }, StaticSpec { name: "obstacles", shape: vec![1, 3] }]
    }

    #[test]
    fn an_episode_sees_its_own_part_of_every_array() {
        let statics = statics();
        assert_eq!(statics.episode(1).get(LANDMARKS), [4.0, 5.0, 6.0, 7.0]);
        assert_eq!(statics.episode(1).get("obstacles"), [7.0; 3]);
        assert_eq!(statics.view().get(LANDMARKS), statics.get(LANDMARKS));
        assert_eq!(statics.episode(0).to_owned().get(LANDMARKS), [0.0, 1.0, 2.0, 3.0]);
        assert!(statics.episode(0).get("walls").is_empty());
    }

    #[test]
    fn what_the_task_does_not_list_or_lists_otherwise_is_named() {
        assert_eq!(statics().validate(&specs(), 2), Ok(()));
        let error = |change: fn(&mut Statics)| {
            let mut statics = statics();
            change(&mut statics);
            statics.validate(&specs(), 2).unwrap_err().to_string()
        };
        assert!(error(|s| s.0.truncate(1)).starts_with("statics: must be landmarks, obstacles"));
        assert!(error(|s| s.0[1].shape = vec![3, 1]).starts_with("obstacles: shape"));
        assert!(error(|s| s.0[0].values.truncate(7)).starts_with("landmarks: 7 numbers"));
        assert!(error(|s| s.0[1].values[2] = f32::NAN).starts_with("obstacles[2]: NaN"));
    }
}
