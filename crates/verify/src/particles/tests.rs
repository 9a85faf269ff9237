use super::recording::Recording;
use super::*;
use crate::Refusal;

fn verify_mpe(text: &str) -> Result<Report, Refusal> {
    crate::compare(text, &mut String::new())
}

fn recording(name: &str) -> Recording {
    Recording::read(&Field::root(&serde_json::from_str(&file(name)).unwrap())).unwrap()
}

fn file(name: &str) -> String {
    let path = format!("{}/testdata/mpe/{name}.json", env!("CARGO_MANIFEST_DIR"));
    std::fs::read_to_string(path).unwrap()
}

const NAMES: [&str; 13] = [
    "spread_n1_integrator",
    "spread_n2_axis",
    "spread_n2_headon_y",
    "spread_n2_overlap",
    "spread_n5_goal",
    "spread_n5_overlap",
    "spread_n20_goal",
    "spread_n50_dense",
    "push_n1_scripted",
    "push_n2_scripted",
    "push_n5_crowd",
    "push_n5_push",
    "push_n20_random_start",
];

#[test]
fn the_recordings_are_reproduced() {
    for name in NAMES {
        let report = verify_mpe(&file(name)).unwrap();
        assert_eq!(report.disagreements(), Vec::<String>::new(), "{name}");
        assert!(report.worst("one step in f32") < 1e-5, "{report:?}");
        assert!(!report.content.contains(", 0 "), "{report:?}");
    }
}

/// The recording `name` with `edit` done to it.
fn edited(name: &str, edit: impl FnOnce(&mut serde_json::Value)) -> String {
    let mut value = serde_json::from_str(&file(name)).unwrap();
    edit(&mut value);
    value.to_string()
}

#[test]
fn bodies_of_general_sizes_take_the_general_path_to_the_same_numbers() {
    // A second agent, far away and slightly larger, sends every pair through the code for mixed bodies.
    let plain = recording("spread_n5_overlap");
    let mut mixed = plain.clone();
    mixed.bodies[0].mass = 1.0 + 1e-15;
    let (a, b) = (replay::verify(&plain), replay::verify(&mixed));
    assert!(a.agrees() && b.agrees(), "{b:?}");
    assert!((a.worst("one step") - b.worst("one step")).abs() < 1e-14);
    let mut pushed = recording("push_n5_crowd");
    pushed.bodies[9].mass = 1.0 + 1e-15;
    assert!(replay::verify(&pushed).agrees());
}

#[test]
fn sizes_masses_and_constants_of_the_file_count() {
    for (name, number) in
        [("dt", 0.11), ("damping", 0.3), ("contact_force", 90.0), ("contact_margin", 2e-3), ("action_sensitivity", 4.0)]
    {
        let text = edited("spread_n20_goal", |value| value["meta"][name] = number.into());
        let report = verify_mpe(&text).unwrap();
        assert!(report.worst("one step") > 1e-6, "{name}: {report:?}");
    }
    for (name, number) in [("size", 0.11), ("mass", 2.0)] {
        let text = edited("spread_n2_overlap", |value| value["entities"][0][name] = number.into());
        let report = verify_mpe(&text).unwrap();
        assert!(report.worst("one step") > 1e-6, "{name}: {report:?}");
    }
}

#[test]
fn a_heavy_agent_is_pushed_less_and_a_fixed_one_not_at_all() {
    // One step of two overlapping agents by hand: F1 = (m2/m1) f, F2 = (m1/m2) f, a = F / m.
    let mut heavy = recording("spread_n2_overlap");
    heavy.bodies[1].mass = 2.0;
    heavy.actions.truncate(1);
    heavy.actions[0] = vec![0, 0];
    heavy.frames.truncate(2);
    heavy.divergence = vec![0.0];
    let before = heavy.frames[0].clone();
    let (p, v) = (&before.positions, &before.velocities);
    let (dx, dy) = (p[0][0] - p[1][0], p[0][1] - p[1][1]);
    let d = libm::hypot(dx, dy);
    let z = -(d - 0.2) / 1e-3;
    let f = 100.0 * 1e-3 * (z.max(0.0) + libm::log1p(libm::exp(-z.abs()))) / d;
    let expect = |recording: &mut Recording, on_first: f64, on_second: f64| {
        let next = &mut recording.frames[1];
        for (i, a) in [(0, on_first), (1, -on_second)] {
            for (k, delta) in [dx, dy].into_iter().enumerate() {
                next.velocities[i][k] = 0.75 * v[i][k] + 0.1 * a * f * delta;
                next.positions[i][k] = p[i][k] + 0.1 * next.velocities[i][k];
            }
        }
    };
    expect(&mut heavy, 2.0, 0.5 / 2.0);
    let report = replay::verify(&heavy);
    assert!(report.worst("one step") < 1e-12, "{report:?}");

    let mut fixed = heavy;
    fixed.bodies[1].movable = false;
    expect(&mut fixed, 1.0, 0.0);
    let velocity = before.velocities[1];
    fixed.frames[1].velocities[1] = velocity;
    fixed.frames[1].positions[1] = before.positions[1];
    let report = replay::verify(&fixed);
    assert!(report.worst("one step") < 1e-12, "{report:?}");
}

#[test]
fn a_disturbed_recording_is_noticed() {
    let report = verify_mpe(&edited("spread_n5_goal", |value| {
        let x = value["pos"][10][2][0].as_f64().unwrap();
        value["pos"][10][2][0] = (x + 1e-9).into();
    }));
    let report = report.unwrap();
    assert!(!report.agrees() && report.worst("one step") > 5e-10, "{report:?}");
    let text = edited("spread_n5_goal", |value| value["reward_exe"][3][1] = 7.0.into());
    assert!(verify_mpe(&text).unwrap().disagreements()[0].contains("reward"));
    let text = edited("spread_n5_goal", |value| value["overlaps"][3] = 99.into());
    assert_eq!(verify_mpe(&text).unwrap().worst("steps with other overlaps"), 1.0);
    let text = edited("push_n5_push", |value| value["ball_of_agent"][0] = 1.into());
    assert!(verify_mpe(&text).unwrap().disagreements()[0].contains("reward"));
    let text = edited("push_n5_push", |value| value["success_rate"][50] = 0.9.into());
    assert!(verify_mpe(&text).unwrap().disagreements()[0].contains("success"));
}

#[test]
fn other_scenarios_and_formats_are_refused_by_name() {
    let text = edited("spread_n1_integrator", |value| value["scenario"] = "tag".into());
    let error = verify_mpe(&text).unwrap_err();
    assert!(matches!(&error, Refusal::Unsupported(reason) if reason.starts_with("scenario: 'tag'")), "{error}");
    let text = edited("spread_n1_integrator", |value| value["format"] = "mpe-golden-2".into());
    assert!(matches!(verify_mpe(&text), Err(Refusal::Unsupported(_))));
    assert!(verify_mpe("{").unwrap_err().to_string().starts_with("recording: not valid JSON"));
    assert!(verify_mpe("[]").unwrap_err().to_string().contains("recording"));
}

#[test]
fn every_missing_or_malformed_field_is_named() {
    for name in ["spread_n2_axis", "push_n2_scripted"] {
        let whole: serde_json::Value = serde_json::from_str(&file(name)).unwrap();
        for field in whole.as_object().unwrap().keys().filter(|field| *field != "note") {
            let text = edited(name, |value| {
                value.as_object_mut().unwrap().remove(field);
            });
            assert!(verify_mpe(&text).unwrap_err().to_string().starts_with(field.as_str()), "{name} {field}");
            let text = edited(name, |value| value[field] = serde_json::json!({"x": 1}));
            assert!(verify_mpe(&text).unwrap_err().to_string().starts_with(field.as_str()), "{name} {field}");
        }
    }
    for field in ["dt", "damping", "contact_force", "contact_margin", "action_sensitivity", "action_uxuy"] {
        let text = edited("spread_n2_axis", |value| {
            value["meta"].as_object_mut().unwrap().remove(field);
        });
        assert_eq!(verify_mpe(&text).unwrap_err().to_string(), format!("meta.{field}: is missing"));
    }
    type Edit = fn(&mut serde_json::Value);
    let broken: [(&str, Edit); 7] = [
        ("actions[2][0]", |value| value["actions"][2][0] = 5.into()),
        ("actions[2]", |value| value["actions"][2] = serde_json::json!([1])),
        ("pos[1][0][1]", |value| value["pos"][1][0][1] = "far".into()),
        ("goal[1]", |value| value["goal"][1] = 2.into()),
        ("entities[0].mass", |value| value["entities"][0]["mass"] = 0.0.into()),
        ("entities[3].kind", |value| value["entities"][3]["kind"] = "agent".into()),
        ("meta.dt", |value| value["meta"]["dt"] = (-0.1).into()),
    ];
    for (field, edit) in broken {
        let error = verify_mpe(&edited("spread_n2_axis", edit)).unwrap_err().to_string();
        assert!(error.starts_with(field), "{field}: {error}");
    }
    let broken: [(&str, Edit); 4] = [
        ("ball_of_agent[1]", |value| value["ball_of_agent"][1] = 2.into()),
        ("land_of_agent[0]", |value| value["land_of_agent"][0] = 2.into()),
        ("n_balls", |value| value["n_balls"] = 0.into()),
        ("entities[2].kind", |value| value["entities"][2]["kind"] = "landmark".into()),
    ];
    for (field, edit) in broken {
        let error = verify_mpe(&edited("push_n2_scripted", edit)).unwrap_err().to_string();
        assert!(error.starts_with(field), "{field}: {error}");
    }
}
