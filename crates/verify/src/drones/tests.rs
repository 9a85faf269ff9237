use super::*;
use crate::Refusal;
use proptest::prelude::*;
use serde_json::{Value, json};

fn verify_drones(text: &str) -> Result<Report, Refusal> {
    crate::compare(text, &mut String::new())
}

fn folder() -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/drones")
}

fn file(name: &str) -> serde_json::Value {
    serde_json::from_str(&std::fs::read_to_string(folder().join(name)).unwrap()).unwrap()
}

#[test]
fn the_recordings_are_reproduced() {
    let dir = std::env::var_os("MAGEX_DRONE_RECORDINGS").map_or_else(folder, Into::into);
    let mut names: Vec<_> = std::fs::read_dir(&dir).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    let mut failures = Vec::new();
    for path in &names {
        let report = verify_drones(&std::fs::read_to_string(path).unwrap()).unwrap();
        println!("{}: {}", path.file_name().unwrap().display(), report.content);
        for m in &report.checks {
            println!("    {:<40} {:.2e} (limit {:?}) {}", m.what, m.worst, m.limit, m.words);
        }
        failures.extend(report.disagreements().into_iter().map(|words| format!("{}: {words}", path.display())));
    }
    assert_eq!(failures, Vec::<String>::new());
    assert!(names.len() >= 3);
}

/// The recording with only its first steps.
fn short(name: &str, periods: usize) -> Value {
    let mut value = file(name);
    let steps = periods * value["steps_per_ctrl"].as_u64().unwrap() as usize;
    (value["T"], value["K"]) = (steps.into(), periods.into());
    for (field, value) in value.as_object_mut().unwrap() {
        if let (Some(list), false) = (value.as_array_mut(), field.starts_with("init_")) {
            let controlled = field == "command" || field.starts_with("ctrl_");
            list.truncate(if controlled { periods } else { steps });
        }
    }
    value
}

fn verify(value: &Value) -> Result<Report, Refusal> {
    verify_drones(&value.to_string())
}

#[test]
fn every_physics_and_every_mode_is_held_against_its_recording() {
    // In names, so that a recording that went missing is noticed.
    for (name, measures) in [
        ("cl_vel_120_120.json", 10),
        ("cl_vel_120_30.json", 8),
        ("dyn_multistep.json", 2),
        ("ol_all_effects.json", 5),
        ("controller_calls.json", 3),
        ("effect_forces.json", 4),
    ] {
        let report = verify(&file(name)).unwrap();
        assert!(report.agrees() && report.checks.len() == measures, "{name}: {report:?}");
    }
}

#[test]
fn constants_of_the_file_count() {
    let base = short("ol_all_effects.json", 20);
    assert!(verify(&base).unwrap().agrees());
    for (name, factor) in [
        ("mass_kg", 1.001),
        ("gravity_m_s2", 1.001),
        ("kf_N_per_rpm2", 1.001),
        ("prop_radius_m", 1.01),
        ("gnd_eff_coeff", 1.01),
        ("drag_coeff_xy", 1.1),
        ("drag_coeff_z", 1.1),
        ("dw_coeff_1", 1.01),
        ("dw_coeff_2", 1.01),
        ("dw_coeff_3", 1.01),
        ("pyb_linear_damping", 1.1),
        ("pyb_angular_damping", 1.1),
    ] {
        let mut value = base.clone();
        let number = value["meta"]["constants"][name].as_f64().unwrap();
        value["meta"]["constants"][name] = (factor * number).into();
        assert!(!verify(&value).unwrap().agrees(), "{name}");
    }
    let mut value = short("cl_vel_120_120.json", 20);
    value["meta"]["constants"]["km_Nm_per_rpm2"] = 8e-12.into();
    assert!(!verify(&value).unwrap().agrees());
    value["meta"]["constants"]["pid"]["D_for"][0] = 0.201.into();
    assert!(verify(&value).unwrap().disagreements().iter().any(|words| words.contains("controller rpm")));
}

#[test]
fn a_disturbed_recording_is_noticed() {
    for (field, delta) in [("pos", 1e-9), ("vel", 1e-9), ("ang_vel", 1e-9), ("quat", 1e-9), ("rpm", 1e-3)] {
        let mut value = short("ol_all_effects.json", 20);
        let number = &mut value[field][10][1][0];
        *number = (number.as_f64().unwrap() + delta).into();
        assert!(!verify(&value).unwrap().agrees(), "{field}");
    }
    let mut value = file("effect_forces.json");
    value["samples"][3]["drones"][0]["gnd_N"] = Value::Null;
    assert!(verify(&value).unwrap().disagreements()[0].contains("ground effect"));
    let mut value = file("controller_calls.json");
    value["sequences"][2]["calls"][4]["rpm"][1] = 15_000.0.into();
    assert!(verify(&value).unwrap().disagreements()[0].contains("controller rpm"));
}

#[test]
fn every_missing_or_malformed_field_is_named() {
    let unread = ["note", "name", "divergence_1e-12", "model_check", "init_rpy", "speed_limit"];
    for name in ["cl_vel_120_120.json", "dyn_multistep.json"] {
        let whole = short(name, 3);
        for field in whole.as_object().unwrap().keys().filter(|field| !unread.contains(&field.as_str())) {
            if name.starts_with("dyn") && (field.starts_with("ctrl_t") || field == "command") {
                continue;
            }
            let mut value = whole.clone();
            value.as_object_mut().unwrap().remove(field);
            assert!(verify(&value).unwrap_err().to_string().starts_with(field.as_str()), "{field}");
            let mut value = whole.clone();
            value[field] = json!({"x": 1});
            assert!(verify(&value).unwrap_err().to_string().starts_with(field.as_str()), "{field}");
        }
    }
    type Edit = fn(&mut Value);
    let broken: [(&str, Edit); 9] = [
        ("physics", |value| value["physics"] = "PYB_WIND".into()),
        ("mode", |value| value["mode"] = "thrust".into()),
        ("steps_per_ctrl", |value| value["K"] = 2.into()),
        ("dt", |value| value["dt"] = 0.01.into()),
        ("pos[1]", |value| value["pos"][1] = json!([])),
        ("quat[2][0]", |value| value["quat"][2][0] = json!([0.0, 0.0, 0.0, 2.0])),
        ("rpm[0][0][3]", |value| value["rpm"][0][0][3] = "fast".into()),
        ("meta.constants.inertia_diag_kg_m2[1]", |value| {
            value["meta"]["constants"]["inertia_diag_kg_m2"][1] = 0.0.into()
        }),
        ("meta.constants.pid.pwm_max", |value| value["meta"]["constants"]["pid"]["pwm_max"] = 1.0.into()),
    ];
    for (field, edit) in broken {
        let mut value = short("cl_vel_120_120.json", 3);
        edit(&mut value);
        let error = verify(&value).unwrap_err().to_string();
        assert!(error.starts_with(&format!("{field}:")), "{field}: {error}");
    }
    assert!(verify_drones("{").unwrap_err().to_string().starts_with("recording: not valid JSON"));
    for format in ["drone-controller-golden-1", "drone-forces-golden-1"] {
        assert!(verify(&json!({"format": format})).unwrap_err().to_string().starts_with("meta"));
    }
}

/// Replaces something somewhere.
fn mutate(value: &mut Value, mut path: &[u16], new: Value) {
    let mut here = value;
    while let Some((&step, rest)) = path.split_first() {
        let len = match &*here {
            Value::Array(list) => list.len(),
            Value::Object(object) => object.len(),
            _ => 0,
        };
        if len == 0 {
            break;
        }
        let k = usize::from(step) % len;
        here = match here {
            Value::Array(list) => &mut list[k],
            Value::Object(object) => object.values_mut().nth(k).unwrap(),
            _ => unreachable!(),
        };
        path = rest;
    }
    *here = new;
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_mutilated_recording_gives_an_error_or_a_report(
        which in 0..5usize,
        edits in prop::collection::vec((prop::collection::vec(any::<u16>(), 1..7), any::<u8>(), any::<f64>()), 1..4),
    ) {
        let name = ["cl_vel_120_120.json", "dyn_multistep.json", "ol_all_effects.json"].get(which);
        let mut value = match name {
            Some(name) => short(name, 3),
            None => file(["controller_calls.json", "effect_forces.json"][which - 3]),
        };
        for (path, kind, number) in edits {
            let new = match kind % 8 {
                0 => Value::Null,
                1 => json!(-1),
                2 => json!(0),
                3 => json!(1e308),
                4 => json!([]),
                5 => json!("text"),
                6 => json!(u64::MAX),
                _ => json!(number),
            };
            mutate(&mut value, &path, new);
        }
        match verify(&value) {
            Ok(report) => prop_assert!(!report.checks.is_empty()),
            Err(error) => prop_assert!(!error.to_string().is_empty()),
        }
    }
}
