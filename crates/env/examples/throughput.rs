//! Joint steps per second of one core, for the sizes of the paper and larger ones; commands per second of the drones.
//!
//! `cargo run --release -p magex-env --example throughput [seconds per size]`

// An example's output is its purpose.
#![allow(clippy::print_stdout)]

use magex_core::task::{Spawn, TaskConfig, TaskName};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let seconds = match std::env::args().nth(1) {
        Some(word) => word.parse()?,
        None => 1.0,
    };
    println!("simple-spread");
    println!("{:>6} {:>8} {:>16} {:>16} {:>16}", "agents", "worlds", "joint steps/s", "steps only, f32", "f64");
    for (agents, worlds) in [(5, 256), (20, 64), (50, 32), (100, 16), (200, 16), (300, 1), (1000, 1), (5000, 1)] {
        let all = magex_env::bench::throughput(agents, worlds, seconds)?;
        if agents <= 200 {
            let [single, double] = magex_env::bench::precisions(agents, worlds, seconds)?;
            println!("{agents:>6} {worlds:>8} {all:>16.0} {single:>16.0} {double:>16.0}");
        } else {
            println!("{agents:>6} {worlds:>8} {all:>16.0}");
        }
    }
    println!("push-ball");
    println!("{:>6} {:>8} {:>16}", "agents", "worlds", "joint steps/s");
    for (agents, worlds) in [(5, 256), (20, 64), (50, 32), (100, 16), (200, 16), (1000, 1)] {
        let task = TaskConfig::of(TaskName::PushBall, agents, Spawn::Uniform);
        println!("{agents:>6} {worlds:>8} {:>16.0}", magex_env::bench::throughput_of(&task, worlds, seconds)?);
    }
    println!("{:>6} {:>8} {:>22} {:>22}", "drones", "episodes", "commands/s, random", "piloted");
    for (drones, episodes) in [(1, 64), (2, 64), (4, 64), (8, 32)] {
        let random = magex_env::bench::drone_throughput(drones, episodes, false, seconds)?;
        let piloted = magex_env::bench::drone_throughput(drones, episodes, true, seconds)?;
        println!("{drones:>6} {episodes:>8} {random:>22.0} {piloted:>22.0}");
    }
    Ok(())
}
