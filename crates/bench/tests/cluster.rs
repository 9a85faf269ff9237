//! The benchmark program as a user calls it, with child processes of `magex` inside.

use serde_json::Value;
use std::process::{Command, Stdio};

#[test]
fn the_cluster_bench_measures_every_row() {
    let place = tempfile::tempdir().unwrap();
    let line = "cluster --agents 5 --episodes 1 --seconds 1 --actors 6 --versions 3 --kills 1 --json";
    let mut command = Command::new(env!("CARGO_BIN_EXE_magex-bench"));
    command.args(line.split(' ')).current_dir(place.path()).stdin(Stdio::null());
    let output = command.env_remove("RUST_LOG").env_remove("CARGO_MANIFEST_DIR").output().unwrap();
    let [stdout, stderr] = [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes));
    assert!(output.status.success(), "{stderr}");
    let value: Value = serde_json::from_str(stdout.lines().last().unwrap()).unwrap();
    let rows = value["cluster"]["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 6, "{value}");
    assert!(rows[0]["agent_steps_per_s"].as_f64().unwrap() > 0.0, "{value}");
    assert!(rows[1]["calls"].as_u64().unwrap() > 0, "{value}");
    assert!(rows[4]["p95_ms"].as_f64().unwrap() > 0.0 && rows[4]["skipped"].as_u64().unwrap() < 3 * 63, "{value}");
    assert!(rows[5]["worst_s"].as_f64().unwrap() > 0.0, "{value}");
}
