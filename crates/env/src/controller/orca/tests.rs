use super::*;
use serde_json::Value;

/// What RVO2 answered in single precision (testdata/record_orca.py).
fn recording() -> Value {
    serde_json::from_str(include_str!("../../../testdata/orca.json")).unwrap()
}

fn vectors(value: &Value) -> Vec<Vector> {
    value.as_array().unwrap().iter().map(|v| [0, 1].map(|d| v[d].as_f64().unwrap())).collect()
}

fn recorded_settings(recording: &Value) -> Settings {
    let number = |name: &str| recording["settings"][name].as_f64().unwrap();
    Settings {
        time_step: number("time_step"),
        time_horizon: number("time_horizon"),
        neighbour_distance: number("neighbour_distance"),
        max_neighbours: number("max_neighbours") as usize,
        radius: number("radius"),
        max_speed: number("max_speed"),
    }
}

#[test]
fn velocities_are_those_of_rvo2() {
    let recording = recording();
    let settings = recorded_settings(&recording);
    let mut compared = 0;
    for scene in recording["scenes"].as_array().unwrap() {
        let [positions, velocities, preferred, chosen] =
            ["positions", "velocities", "preferred", "chosen"].map(|name| vectors(&scene[name]));
        let by_x = sorted_by_x(&positions);
        for agent in 0..positions.len() {
            let near = neighbours(&settings, &positions, &by_x, agent);
            let own = velocity(&settings, (&positions, &velocities), (agent, &near), preferred[agent]);
            let off = square(sub(own, chosen[agent])).sqrt();
            assert!(off < 1e-4, "{}, agent {agent}: {own:?}, RVO2 {:?}", scene["name"], chosen[agent]);
            compared += 1;
        }
    }
    assert!(compared > 120);
}

#[test]
fn neighbours_are_the_nearest_ones_in_order() {
    let mut stream = Key::new(2, magex_core::rng::Purpose::Instances, &[9]).stream();
    let settings = Settings { max_neighbours: 4, ..recorded_settings(&recording()) };
    for _ in 0..50 {
        let positions: Vec<Vector> = (0..30).map(|_| [(); 2].map(|()| stream.range(-3.0, 3.0))).collect();
        let by_x = sorted_by_x(&positions);
        for agent in 0..30 {
            let distance = |k: u32| square(sub(positions[k as usize], positions[agent])).sqrt();
            let mut all: Vec<u32> = (0..30).filter(|&k| k as usize != agent && distance(k) < 2.0).collect();
            all.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)));
            all.truncate(4);
            assert_eq!(neighbours(&settings, &positions, &by_x, agent), all);
        }
    }
}

#[test]
fn agents_at_one_place_part_and_every_velocity_is_finite_and_slow_enough() {
    let settings = recorded_settings(&recording());
    let positions = vec![[0.5, 0.5]; 12];
    let velocities = vec![[0.0; 2]; 12];
    let by_x = sorted_by_x(&positions);
    for agent in 0..12 {
        let near = neighbours(&settings, &positions, &by_x, agent);
        let chosen = velocity(&settings, (&positions, &velocities), (agent, &near), [0.0; 2]);
        assert!(square(chosen).sqrt() <= settings.max_speed + 1e-9, "{chosen:?}");
    }
    let two = |agent: usize| velocity(&settings, (&positions, &velocities), (agent, &[1 - agent as u32]), [0.0; 2]);
    assert!(two(0)[0] < -0.5 && two(1)[0] > 0.5, "{:?} {:?}", two(0), two(1));
}
