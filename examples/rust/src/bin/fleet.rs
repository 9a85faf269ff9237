//! A fleet: 20 robots, tasks that arrive, one robot that fails, and the waiting times beside those of "greedy nearest".
//!
//! ```sh
//! cargo run --release -- commander &                       # or any running commander
//! cargo run -p magex-example-client --bin fleet -- http://127.0.0.1:7100 fleet.svg
//! ```
//!
//! The world is a simulation of one second per step. The commander keeps the fleet as a mission and plans it anew with every step;
//! finished tasks are forgotten by themselves, so this could go on for ever.
#![allow(clippy::print_stdout, reason = "an example talks")]

#[path = "../connect.rs"]
mod connect;

use anyhow::Context as _;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_proto::v1::{CreateMissionRequest, DeleteMissionRequest, Member, MemberState, UpdateMissionRequest};
use std::collections::BTreeMap;
use std::fmt::Write as _;

const ROBOTS: usize = 20;
const SIDE: f64 = 100.0;
const SECONDS: u32 = 900;
/// Tasks per second, and seconds of work at a task.
const RATE: f64 = 0.42;
const WORK: f64 = 8.0;
/// Robot 0 fails and comes back.
const FAILS: std::ops::Range<u32> = 300..500;

/// Random numbers in 0..1: a linear congruential generator is enough for an example.
struct Draw(u64);

impl Draw {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    fn point(&mut self) -> [f64; 2] {
        [SIDE * self.next(), SIDE * self.next()]
    }
}

struct Robot {
    place: [f64; 2],
    speed: f64,
    busy_until: f64,
}

struct Task {
    place: [f64; 2],
    since: u32,
}

/// Robots and tasks; the same for both dispatchers.
struct World {
    robots: Vec<Robot>,
    arrivals: Vec<(u32, [f64; 2])>,
    /// By number.
    open: BTreeMap<usize, Task>,
    waited: Vec<f64>,
}

fn way([x, y]: [f64; 2], [gx, gy]: [f64; 2]) -> f64 {
    ((gx - x) * (gx - x) + (gy - y) * (gy - y)).sqrt()
}

impl World {
    fn new() -> Self {
        let mut draw = Draw(1);
        let mut robot = |_| Robot { place: draw.point(), speed: 1.0 + draw.next(), busy_until: 0.0 };
        let robots = (0..ROBOTS).map(&mut robot).collect();
        let mut arrivals = Vec::new();
        for second in 0..SECONDS {
            if draw.next() < RATE {
                arrivals.push((second, draw.point()));
            }
        }
        Self { robots, arrivals, open: BTreeMap::new(), waited: Vec::new() }
    }

    fn new_tasks(&mut self, now: u32) -> Vec<usize> {
        let new: Vec<usize> = (0..self.arrivals.len()).filter(|&k| self.arrivals[k].0 == now).collect();
        self.open.extend(new.iter().map(|&k| (k, Task { place: self.arrivals[k].1, since: now })));
        new
    }

    fn works(robot: usize, now: u32) -> bool {
        robot != 0 || !FAILS.contains(&now)
    }

    /// Moves every robot towards its goal for a second. Returns the tasks that were begun.
    fn drive(&mut self, goals: &BTreeMap<usize, usize>, now: u32) -> Vec<usize> {
        let mut begun = Vec::new();
        for (&k, &task) in goals {
            let robot = &mut self.robots[k];
            let Some(to) = self.open.get(&task).map(|task| task.place) else { continue };
            if robot.busy_until > f64::from(now) || !Self::works(k, now) {
                continue;
            }
            let left = way(robot.place, to);
            if left > robot.speed {
                let step = robot.speed / left;
                robot.place = [0, 1].map(|axis| robot.place[axis] + step * (to[axis] - robot.place[axis]));
                continue;
            }
            (robot.place, robot.busy_until) = (to, f64::from(now) + WORK);
            if let Some(task) = self.open.remove(&task) {
                self.waited.push(f64::from(now + 1 - task.since));
            }
            begun.push(task);
        }
        begun
    }

    fn waiting_times(mut self) -> Vec<f64> {
        self.waited.extend(self.open.values().map(|task| f64::from(SECONDS - task.since)));
        self.waited.sort_unstable_by(f64::total_cmp);
        self.waited
    }
}

/// Each free robot takes the nearest task that no robot has, and keeps it.
fn greedy_nearest() -> Vec<f64> {
    let (mut world, mut goals) = (World::new(), BTreeMap::new());
    for now in 0..SECONDS {
        world.new_tasks(now);
        goals.retain(|&robot, task| world.open.contains_key(task) && World::works(robot, now));
        for k in 0..ROBOTS {
            let robot = &world.robots[k];
            if goals.contains_key(&k) || robot.busy_until > f64::from(now) || !World::works(k, now) {
                continue;
            }
            let free = world.open.iter().filter(|(task, _)| !goals.values().any(|own| own == *task));
            let nearest = free.min_by(|a, b| way(robot.place, a.1.place).total_cmp(&way(robot.place, b.1.place)));
            if let Some(task) = nearest.map(|(task, _)| *task) {
                goals.insert(k, task);
            }
        }
        world.drive(&goals, now);
    }
    world.waiting_times()
}

async fn with_commander(url: &str) -> anyhow::Result<Vec<f64>> {
    let mut client = CommanderServiceClient::new(connect::to(url).await?);
    let (mut world, mut begun) = (World::new(), Vec::new());
    let robot = |(k, robot): (usize, &Robot)| Member {
        id: format!("robot-{k}"),
        position: robot.place.to_vec(),
        speed: Some(robot.speed),
        ..Default::default()
    };
    let request = CreateMissionRequest {
        title: "fleet".to_owned(),
        agents: world.robots.iter().enumerate().map(robot).collect(),
        // A robot changes its goal only if that saves the team more than two seconds.
        switching_cost: 2.0,
        ..Default::default()
    };
    let made = client.create_mission(request).await?.into_inner().assignment.context("no assignment")?;
    let mission_id = made.mission_id;
    for now in 0..SECONDS {
        let new = world.new_tasks(now);
        let state = |k| if World::works(k, now) { MemberState::Active } else { MemberState::Failed };
        let robot = |(k, robot): (usize, &Robot)| Member {
            id: format!("robot-{k}"),
            position: robot.place.to_vec(),
            busy_until: Some(robot.busy_until),
            state: state(k).into(),
            ..Default::default()
        };
        let done = |task: usize| Member {
            id: format!("task-{task}"),
            state: MemberState::Finished.into(),
            ..Default::default()
        };
        let open = |(k, task): (&usize, &Task)| Member {
            id: format!("task-{k}"),
            position: if new.contains(k) { task.place.to_vec() } else { Vec::new() },
            // Tasks that have waited longer go first when there are more of them than robots.
            weight: Some(1.0 + f64::from(now - task.since) / 30.0),
            ..Default::default()
        };
        let update = UpdateMissionRequest {
            mission_id: mission_id.clone(),
            time: Some(f64::from(now)),
            agents: world.robots.iter().enumerate().map(robot).collect(),
            goals: begun.drain(..).map(done).chain(world.open.iter().map(open)).collect(),
            ..Default::default()
        };
        let planned = client.update_mission(update).await?.into_inner().assignment.context("no assignment")?;
        let number = |name: &str| name.rsplit('-').next().and_then(|number| number.parse::<usize>().ok());
        let goal = |pair: &magex_proto::v1::Pair| Some((number(&pair.agent_id)?, number(&pair.goal_id)?));
        let goals = planned.pairs.iter().filter_map(goal).collect();
        begun = world.drive(&goals, now);
    }
    client.delete_mission(DeleteMissionRequest { mission_id }).await?;
    Ok(world.waiting_times())
}

/// Share of the tasks that waited at most that time, as an SVG.
fn plot(curves: &[(&str, &str, Vec<f64>)]) -> String {
    let longest = curves.iter().filter_map(|(.., times)| times.last()).copied().fold(1.0, f64::max);
    let mut svg = String::from(
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 640 360" font-family="sans-serif" font-size="14"><path d="M60 20V300H620" fill="none" stroke="#444"/>"##,
    );
    let _ = write!(svg, r#"<text x="340" y="345" text-anchor="middle">waiting time, 0 to {longest:.0} seconds</text>"#);
    svg.push_str(
        r#"<text x="20" y="160" transform="rotate(-90 20 160)" text-anchor="middle">share of tasks, 0 to 1</text>"#,
    );
    for (k, (name, colour, times)) in curves.iter().enumerate() {
        svg.push_str(r#"<polyline fill="none" stroke-width="2" points="60,300"#);
        for (i, wait) in times.iter().enumerate() {
            let (x, y) = (60.0 + 560.0 * wait / longest, 300.0 - 280.0 * (i + 1) as f64 / times.len() as f64);
            let _ = write!(svg, " {x:.1},{y:.1}");
        }
        let _ = write!(
            svg,
            r#"" stroke="{colour}"/><text x="600" y="{}" text-anchor="end" fill="{colour}">{name}</text>"#,
            240 + 20 * k
        );
    }
    svg + "</svg>\n"
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let url = std::env::args().nth(1).unwrap_or_else(|| "http://127.0.0.1:7100".to_owned());
    let curves =
        [("greedy nearest", "#c4421a", greedy_nearest()), ("commander", "#1a6fc4", with_commander(&url).await?)];
    for (name, _, times) in &curves {
        let count = times.len();
        let mean = times.iter().sum::<f64>() / count as f64;
        let (high, most) = (times[count * 95 / 100], times[count - 1]);
        println!("{name}: {count} tasks, waiting {mean:.1} s on average, 95 % below {high:.0} s, at most {most:.0} s");
    }
    if let Some(path) = std::env::args().nth(2) {
        std::fs::write(&path, plot(&curves)).with_context(|| path.clone())?;
        println!("plot: {path}");
    }
    Ok(())
}
