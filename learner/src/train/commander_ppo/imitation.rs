//! Imitation of the exact solver: the scheduler learns to give the exact assignment's picks a high probability, before PPO
//! goes on from there.

use super::{CommanderError, CommanderPpo};
use crate::train::batch::column;
use crate::train::learned::Network;
use magex_nets::commander::{Commander, Instance, Team};
use magex_nets::ops::Pick;

/// One team and what the exact solver decides for it.
#[derive(Debug, Clone)]
pub struct Lesson {
    /// What the network sees.
    pub instance: Instance,
    /// The exact assignment, in the order of the picks.
    pub picks: Vec<Pick>,
}

impl Lesson {
    /// A team with its exact assignment, `[N]` goals.
    ///
    /// # Errors
    /// A team that the scheduler does not serve, goals that are not one-to-one.
    pub fn new(commander: &Commander, team: &Team<'_>, exact: &[u32]) -> Result<Self, CommanderError> {
        let instance = commander.instance(team)?;
        let picks = instance
            .picks_of(exact)
            .ok_or_else(|| CommanderError::Instance("the exact assignment is not one-to-one".to_owned()))?;
        Ok(Self { instance, picks })
    }
}

impl CommanderPpo {
    /// One gradient step on the cross-entropy of the lessons' picks, every team counting the same whatever its size. Returns
    /// the cross-entropy before the step, in nats per pick.
    ///
    /// # Errors
    /// Lessons of another scheduler, and what the tensor library refuses.
    pub fn imitate(&self, network: &mut Network, lessons: &[Lesson], rate: f64) -> Result<f64, CommanderError> {
        let (commander, variables) = self.differentiable(network)?;
        let instances: Vec<&Instance> = lessons.iter().map(|lesson| &lesson.instance).collect();
        let picks: Vec<&[Pick]> = lessons.iter().map(|lesson| &*lesson.picks).collect();
        let log_probs = commander.pick_log_probs(&instances, &picks)?.get(0)?;
        let share = |picks: &&[Pick]| std::iter::repeat_n(1.0 / (picks.len() * lessons.len()) as f32, picks.len());
        let weights: Vec<f32> = picks.iter().flat_map(share).collect();
        let loss = (log_probs * column(weights)?)?.sum_all()?.neg()?;
        self.descend(network, &variables, &loss, rate)?;
        Ok(f64::from(loss.to_scalar::<f32>()?))
    }
}
