//! Episodes as native code steps them, world by world, for test_bits.py: TASK AGENTS WORLDS SEED EPISODE goals|team. Writes the
//! positions and rewards of every step to standard output, little-endian f32, the worlds one after another.

use magex_assign::exact_points;
use magex_core::joint_state::group_positions;
use magex_core::rng::{Key, Purpose};
use magex_core::statics::LANDMARKS;
use magex_core::task::{RewardTarget, Spawn, TaskConfig, TaskName};
use magex_env::new_env;
use std::error::Error;
use std::io::Write;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [task, agents, worlds, seed, episode, reward] = &args[..] else {
        return Err("needs TASK AGENTS WORLDS SEED EPISODE goals|team".into());
    };
    let (agents, worlds): (usize, usize) = (agents.parse()?, worlds.parse()?);
    let (seed, episode): (u64, u32) = (seed.parse()?, episode.parse()?);
    let name = TaskName::SIMULATED.into_iter().find(|name| name.to_string() == *task).ok_or("no such task")?;
    let mut task = TaskConfig::of(name, agents, Spawn::Uniform);
    task.reward_target = if reward == "team" { RewardTarget::Team } else { RewardTarget::Goals };
    let (shape, choices) = (task.shape(1), task.action_heads()[0]);
    let mut out = std::io::stdout().lock();
    for world in 0..worlds {
        let stream = Key::new(seed + world as u64, Purpose::Spawn, &[episode]).stream();
        let mut env = new_env(&task, std::iter::once(stream), false)?;
        let positions = env.positions();
        let groups = (&positions[..], env.statics().get(LANDMARKS));
        let mut answers = Vec::new();
        for stage in task.stages() {
            let [from, to] = [stage.from, stage.to].map(|group| group_positions(&shape, groups, group, 0));
            answers.push(exact_points(from, to, shape.dims)?.0);
        }
        let mut goals = Vec::new();
        for agent in 0..agents {
            let mut at = agent;
            for answer in &answers {
                at = answer[at] as usize;
                goals.push(at as u32);
            }
        }
        env.set_goals(&goals)?;
        let mut rewards = vec![0.0; agents];
        for step in 0..task.horizon as usize {
            let heads = shape.action_components;
            // The same formula stands in the test.
            let action = |k: usize| ((31 * step + 17 * (k / heads) + 7 * world + 3 * (k % heads)) % choices) as u8;
            let actions: Vec<u8> = (0..agents * heads).map(action).collect();
            env.step(&actions, &mut rewards)?;
            for number in env.positions().iter().chain(&rewards) {
                out.write_all(&number.to_le_bytes())?;
            }
        }
    }
    Ok(())
}
