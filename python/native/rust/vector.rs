//! The worlds as a Python class.

use crate::arrays::{array, read, refused, room};
use crate::options::{Named, Options};
use crate::worlds::{self, Outputs};
use magex_core::error::FieldError;
use numpy::{PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyReadwriteArrayDyn};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// W worlds of one task. `magex.envs.vector` is the face of it; arrays are C-contiguous.
#[pyclass(frozen, module = "magex_native")]
pub(crate) struct Worlds {
    inner: Mutex<worlds::Worlds>,
    /// W, N, D, E, K, H, V, X.
    sizes: [usize; 8],
    horizon: u32,
    side: f32,
    choices: usize,
    step_seconds: f32,
    landmark_radius: f32,
}

/// The arrays of a state: positions and velocities [W, E, D], agent_state [W, N, X], landmarks [W, N, D], goals [W, N, K].
type State<'py> = ([Bound<'py, PyArrayDyn<f32>>; 4], Bound<'py, PyArrayDyn<u32>>);

#[pymethods]
impl Worlds {
    #[new]
    #[pyo3(signature = (task, agents, worlds, *, spawn, side, horizon, reward, observation, neighbours, settings, threads))]
    #[allow(clippy::too_many_arguments, reason = "they are the keywords of a Python call")]
    fn new(
        task: &str,
        agents: usize,
        worlds: usize,
        spawn: &str,
        side: Option<f64>,
        horizon: Option<u32>,
        reward: &str,
        observation: &str,
        neighbours: usize,
        settings: Option<&Bound<'_, PyDict>>,
        threads: usize,
    ) -> PyResult<Self> {
        let named = Named { task, agents, spawn, side, horizon, reward, observation, neighbours, settings };
        let inner = Options::read(&named).and_then(|options| worlds::Worlds::new(options, worlds, threads));
        let inner = inner.map_err(refused)?;
        let (task, s) = (&inner.plan.task, inner.plan.shape);
        Ok(Self {
            sizes: [
                inner.plan.worlds,
                s.agents,
                s.dims,
                s.bodies,
                s.goals_per_agent,
                s.action_components,
                inner.width(),
                s.agent_state,
            ],
            horizon: task.horizon,
            side: task.side,
            choices: task.action_heads()[0],
            step_seconds: task.definition().step_seconds,
            landmark_radius: task.definition().landmark_radius,
            inner: Mutex::new(inner),
        })
    }

    /// W, N, D, E, K, H, V, X: worlds, agents, dimensions, bodies, goals per agent, action components, width of an observation,
    /// further numbers of an agent's state.
    #[getter]
    fn sizes(&self) -> [usize; 8] {
        self.sizes
    }

    /// Joint steps of an episode.
    #[getter]
    fn horizon(&self) -> u32 {
        self.horizon
    }

    /// Side of the map, world units.
    #[getter]
    fn side(&self) -> f32 {
        self.side
    }

    /// Choices of every action component.
    #[getter]
    fn choices(&self) -> usize {
        self.choices
    }

    /// Seconds per joint step.
    #[getter]
    fn step_seconds(&self) -> f32 {
        self.step_seconds
    }

    /// Radius that a landmark is drawn with, world units.
    #[getter]
    fn landmark_radius(&self) -> f32 {
        self.landmark_radius
    }

    /// Joint steps of the present episode that are done.
    #[getter]
    fn steps(&self, py: Python<'_>) -> u32 {
        py.detach(|| self.lock().steps)
    }

    /// Begins an episode in every world: world w has the seed + w; without a seed the next episode of the last one. `start` has
    /// positions and velocities float32 [W, E, D] and landmarks float32 [W, N, D] to begin with.
    #[pyo3(signature = (seed=None, start=None))]
    fn reset(
        &self,
        py: Python<'_>,
        seed: Option<u64>,
        start: Option<[PyReadonlyArrayDyn<'_, f32>; 3]>,
    ) -> PyResult<()> {
        let [w, n, d, e, ..] = self.sizes;
        let bodies = [w, e, d];
        let start = match &start {
            None => None,
            Some([positions, velocities, landmarks]) => Some([
                read("positions", positions, bodies)?,
                read("velocities", velocities, bodies)?,
                read("landmarks", landmarks, [w, n, d])?,
            ]),
        };
        py.detach(|| self.lock().reset(seed, start)).map_err(refused)
    }

    /// Takes goals, uint32 [W, N, K].
    fn set_goals(&self, py: Python<'_>, goals: PyReadonlyArrayDyn<'_, u32>) -> PyResult<()> {
        let [w, n, _, _, k, ..] = self.sizes;
        let goals = read("goals", &goals, [w, n, k])?;
        py.detach(|| self.lock().set_goals(goals)).map_err(refused)
    }

    /// Writes the present observations, float32 [W, N, V].
    fn observe(&self, py: Python<'_>, mut out: PyReadwriteArrayDyn<'_, f32>) -> PyResult<()> {
        let out = room("out", &mut out, &self.observations())?;
        py.detach(|| self.lock().observe(out)).map_err(refused)
    }

    /// One joint step: actions uint8, int32 or int64 [W, N, H]; writes rewards float32 [W, N] and, where arrays are given, the
    /// observations after the step and those of the last state of ended episodes, float32 [W, N, V]. Returns whether the episodes
    /// ended, and if so their metrics by name, float32 [W].
    #[pyo3(signature = (actions, rewards, observations, last, restart))]
    fn step<'py>(
        &self,
        py: Python<'py>,
        actions: &Bound<'py, PyAny>,
        mut rewards: PyReadwriteArrayDyn<'py, f32>,
        mut observations: Option<PyReadwriteArrayDyn<'py, f32>>,
        mut last: Option<PyReadwriteArrayDyn<'py, f32>>,
        restart: bool,
    ) -> PyResult<(bool, Bound<'py, PyDict>)> {
        let [w, n, _, _, _, h, ..] = self.sizes;
        let (shape, wide) = ([w, n, h], self.observations());
        let outputs = Outputs {
            rewards: room("rewards", &mut rewards, &[w, n])?,
            observations: observations.as_mut().map(|out| room("observations", out, &wide)).transpose()?,
            last: last.as_mut().map(|out| room("last", out, &wide)).transpose()?,
        };
        let stepped = if let Ok(actions) = actions.cast::<PyArrayDyn<u8>>() {
            let actions = actions.try_readonly()?;
            let actions = read("actions", &actions, shape)?;
            self.check(actions)?;
            py.detach(|| self.lock().step(actions, outputs, restart))
        } else if let Ok(actions) = actions.cast::<PyArrayDyn<i64>>() {
            let actions = actions.try_readonly()?;
            let actions = self.small(read("actions", &actions, shape)?)?;
            py.detach(|| self.lock().step(&actions, outputs, restart))
        } else if let Ok(actions) = actions.cast::<PyArrayDyn<i32>>() {
            let actions = actions.try_readonly()?;
            let actions = self.small(read("actions", &actions, shape)?)?;
            py.detach(|| self.lock().step(&actions, outputs, restart))
        } else {
            let problem = "must be an array of uint8, int32 or int64; pass numpy.asarray(actions, dtype=numpy.uint8)";
            return Err(refused(FieldError::new("actions", problem)));
        }
        .map_err(refused)?;
        let metrics = PyDict::new(py);
        for (name, values) in stepped.metrics {
            metrics.set_item(name, array(py, values, &[w])?)?;
        }
        Ok((stepped.ended, metrics))
    }

    /// Positions and velocities float32 [W, E, D], agents first, then balls; further state of the agents float32 [W, N, X];
    /// landmarks float32 [W, N, D]; goals uint32 [W, N, K]. Copies.
    fn state<'py>(&self, py: Python<'py>) -> PyResult<State<'py>> {
        let [w, n, d, e, k, _, _, x] = self.sizes;
        let ([positions, velocities, agent_state, landmarks], goals) =
            py.detach(|| self.lock().state()).map_err(refused)?;
        let arrays = [
            array(py, positions, &[w, e, d])?,
            array(py, velocities, &[w, e, d])?,
            array(py, agent_state, &[w, n, x])?,
            array(py, landmarks, &[w, n, d])?,
        ];
        Ok((arrays, array(py, goals, &[w, n, k])?))
    }
}

impl Worlds {
    /// The worlds, for this thread alone. Never waited for while the interpreter's lock is held.
    fn lock(&self) -> MutexGuard<'_, worlds::Worlds> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn observations(&self) -> [usize; 3] {
        let [w, n, _, _, _, _, v, _] = self.sizes;
        [w, n, v]
    }

    /// `Ok` if every action is a choice: no world may step before all are known to.
    fn check(&self, actions: &[u8]) -> PyResult<()> {
        // The maximum first: it vectorises, the search does not.
        if usize::from(actions.iter().fold(0, |most, &action| most.max(action))) < self.choices {
            return Ok(());
        }
        let place = actions.iter().position(|&action| usize::from(action) >= self.choices).unwrap_or_default();
        Err(self.no_action(place, i64::from(actions[place])))
    }

    /// Actions of another type.
    fn small<T: Copy + Into<i64>>(&self, actions: &[T]) -> PyResult<Vec<u8>> {
        let choices = self.choices as i64;
        let bad = |action: &T| !(0..choices).contains(&(*action).into());
        if actions.iter().filter(|action| bad(action)).count() == 0 {
            return Ok(actions.iter().map(|&action| action.into() as u8).collect());
        }
        let place = actions.iter().position(bad).unwrap_or_default();
        Err(self.no_action(place, actions[place].into()))
    }

    fn no_action(&self, place: usize, action: i64) -> PyErr {
        let [_, n, _, _, _, h, ..] = self.sizes;
        let field = format!("actions[{}][{}]", place / (n * h), place / h % n);
        let component = if h > 1 { format!("[{}]", place % h) } else { String::new() };
        let problem = format!("{action} is not an action; use 0 to {}", self.choices - 1);
        refused(FieldError::new(field + &component, problem))
    }
}
