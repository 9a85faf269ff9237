//! Wrong inputs that are written by hand, and the files that they name.

use super::{Row, row, with};
use magex_tests::sandbox::binary;
use std::path::Path;
use std::process::Command;

/// Rows that no table knows.
pub(crate) fn rows() -> Vec<Row> {
    let mut rows: Vec<Row> = [
        ("trian", 64, &["trian", "is train meant"] as &[&str]),
        ("train {f}/none.toml", 64, &["{f}/none.toml", "no such file"]),
        ("train {f}/folder", 64, &["{f}/folder", "is a folder"]),
        ("train {f}/noise", 64, &["{f}/noise", "not a text file"]),
        ("train {f}/noise/below", 64, &["{f}/noise/below", "is a file"]),
        ("train {f}/ring.toml", 64, &["task.spawn", "'ring'", "use uniform"]),
        ("train {f}/agents-only.toml", 64, &["task.name", "simple-spread"]),
        ("train {f}/open-table.toml", 64, &["open-table.toml", "line 2"]),
        ("train {f}/no-section.toml", 64, &["run", "[section]"]),
        ("train {f}/twice.toml", 64, &["twice.toml", "line 3"]),
        ("train {f}/huge.toml", 64, &["huge.toml", "line 2", "9223372036854775807"]),
        ("train {f}/beyond.toml", 64, &["beyond.toml", "line 2", "9223372036854775807"]),
        ("train {f}/renamed.toml", 64, &["mappo.clip", "mappo.clip_epsilon"]),
        ("train {f}/other-section.toml", 64, &["task.drones", "push-ball"]),
        ("train {f}/strange.toml", 64, &["strange", "use run"]),
        ("train {f}/shards.toml", 64, &["collect.shards_per_iteration", "divide"]),
        ("train {f}/chunk.toml", 64, &["mappo.chunk_length", "divide"]),
        ("train --seed 9223372036854775808", 64, &["--seed", "0 to 9223372036854775807"]),
        ("train --max-steps 99999999999999999999", 64, &["--max-steps", "1 to 1000000000000"]),
        ("train --set run.seed", 64, &["--set", "KEY=VALUE"]),
        ("train --set run.sed=1 --print-config", 64, &["--set", "run.sed", "use algorithm, seed"]),
        ("train --set run.seed=five --print-config", 64, &["--set", "run.seed", "a whole number"]),
        ("train {f}/ring.toml --set run.seed=1", 64, &["ring.toml", "task.spawn"]),
        ("train --seeds 1,2 --seed 3", 64, &["--seeds", "--seed", "leave one out"]),
        ("train --seeds 1,2,1", 64, &["--seeds", "1 is named twice"]),
        ("train --seeds 1 --resume --out {f}/none", 64, &["{f}/none", "does not exist"]),
        ("train --name ../up", 64, &["--name", "../up"]),
        ("train --name ''", 64, &["--name"]),
        ("train --name a --out b", 64, &["--name", "--out"]),
        ("train --whole-budget --target-success 1", 64, &["--whole-budget", "--target-success"]),
        ("train --resume", 64, &["--resume", "--out"]),
        ("train --resume --name none", 64, &["runs/none", "does not exist"]),
        ("train --resume --out {f}/folder", 64, &["{f}/folder", "config.toml"]),
        ("train --out {f}/run --in-process", 73, &["--out {f}/run", "--resume"]),
        ("train --out {f}/noise --in-process", 73, &["--out {f}/noise"]),
        ("train --out {f}/noise/below --in-process", 73, &["--out {f}/noise/below"]),
        ("train --out /proc/new --in-process", 73, &["--out /proc/new"]),
        ("train --http off --actors 1000", 64, &["--actors", "1 to 256"]),
        ("train --http nowhere", 64, &["--http nowhere"]),
        ("train-commander --imitation 0 --ppo 0", 64, &["--imitation", "--ppo"]),
        ("train-commander {f}/ranking.toml", 64, &["commander.kind"]),
        ("train-commander --out {f}/run", 73, &["--out {f}/run"]),
        ("train-commander --out /proc/new", 73, &["--out /proc/new"]),
        ("eval", 64, &["<RUN>"]),
        ("eval {f}/none", 64, &["{f}/none", "does not exist"]),
        ("eval {f}/noise", 64, &["{f}/noise", "--config"]),
        ("eval {f}/folder", 64, &["{f}/folder", "not a run folder"]),
        ("eval {f}/noise --config {f}/run/config.toml", 1, &["{f}/noise"]),
        ("eval {f}/empty --config {f}/run/config.toml", 1, &["{f}/empty"]),
        ("eval {f}/run --config {f}/run/config.toml", 64, &["--config"]),
        ("eval {f}/run --eval-set 2", 64, &["--eval-set", "3 or more"]),
        ("eval {f}/run --horizon 0", 64, &["--horizon", "1 to 100000"]),
        ("eval {f}/run --agents 5001", 64, &["--agents", "1 to 5000"]),
        ("eval {f}/run --per-layout", 64, &["--per-layout", "--spawn lines"]),
        ("eval {f}/run --scheduler ranking", 64, &["--scheduler ranking"]),
        ("eval {f}/run --seeds 1", 64, &["--seeds", "--episode-seeds"]),
        ("eval {f}/run --episodes 1 --record {f}/folder", 73, &["{f}/folder"]),
        ("eval {f}/run --episodes 1 --record {f}/noise/x.html", 73, &["{f}/noise"]),
        ("eval {f}/broken --episodes 1", 1, &["none of the", "weights.safetensors"]),
        ("eval {f}/headless --episodes 1", 64, &["config.toml"]),
        ("replay {f}/run --episodes 101", 64, &["--episodes", "1 to 100"]),
        ("replay {f}/run --episodes 1 --out /proc/new.html", 73, &["/proc/new.html"]),
        ("replay {f}/run --episodes 1 --out {f}/noise/below/x.html", 73, &["{f}/noise/below"]),
        ("compare", 64, &["<RUN>"]),
        ("compare {f}/none", 64, &["{f}/none", "does not exist"]),
        ("compare {f}/noise", 64, &["{f}/noise"]),
        ("compare {f}/folder", 64, &["{f}/folder", "not a run folder"]),
        ("compare {f}/run {f}/run", 64, &["{f}/run", "named twice"]),
        ("compare {f}/run --svg {f}/folder", 73, &["{f}/folder"]),
        ("compare {f}/run --csv /proc/new.csv", 73, &["/proc/new.csv"]),
        ("reproduce --table none", 64, &["--table", "spread"]),
        ("reproduce --systems none", 64, &["--systems", "mage-x"]),
        ("reproduce --seeds 1,1", 64, &["--seeds", "1 is named twice"]),
        ("reproduce --max-minutes 0", 64, &["--max-minutes", "0.001"]),
        ("reproduce --tables-only --out {f}/none", 64, &["{f}/none", "does not exist"]),
        ("reproduce --tables-only --out {f}/folder", 64, &["{f}/folder", "no results"]),
        ("reproduce --out {f}/noise", 73, &["{f}/noise"]),
        ("reproduce --out /proc/new", 73, &["/proc/new"]),
        ("assign", 64, &["--agents"]),
        ("assign --agents five", 64, &["--agents five", "no such file"]),
        ("assign --agents ''", 64, &["--agents"]),
        ("assign --agents {f}/folder", 64, &["--agents {f}/folder", "is a folder"]),
        ("assign --agents {f}/noise", 64, &["--agents {f}/noise", "not a text file"]),
        ("assign --agents {f}/empty", 64, &["--agents", "JSON"]),
        ("assign --agents -", 64, &["--agents", "JSON"]),
        ("assign --agents [[0,0]]", 64, &["--agents", "goals"]),
        ("assign --agents [[0,0] --goals [[0,1]]", 64, &["--agents", "line 1, column"]),
        ("assign --agents [[0,0]] --goals [[0,1],5]", 64, &["--goals[1]", "5"]),
        ("assign --agents [[0,0]] --goals [[0,\"a\"]]", 64, &["--goals[0][1]", "\"a\""]),
        ("assign --agents [[0,1e400]] --goals [[0,1]]", 64, &["--agents", "line 1, column 9"]),
        ("assign --agents [[0,null]] --goals [[0,1]]", 64, &["--agents[0][1]", "null"]),
        ("assign --agents [[0]] --goals [[0,1]]", 64, &["agents", "2 or 3"]),
        ("assign --agents [[0,0],[1,1,1]] --goals [[0,1]]", 64, &["agents[1]"]),
        ("assign --agents {\"agents\":5} --goals [[0,1]]", 64, &["--agents"]),
        ("assign --agents {\"agents\":[[0,0]]}", 64, &["goals", "missing"]),
        ("assign --agents {\"robots\":[[0,0]]}", 64, &["robots"]),
        ("assign --random 2 --agents [[0,0]]", 64, &["--random", "--agents"]),
        ("assign --random 5001", 64, &["--random", "1 to 5000"]),
        ("assign --random 2 --connect http://127.0.0.1:9", 69, &["127.0.0.1:9"]),
        ("assign --random 2 --connect http://no.such.host.invalid:9", 69, &["no.such.host.invalid"]),
        ("assign --random 2 --connect https://127.0.0.1:9", 64, &["--connect", "--tls-ca"]),
        ("health nowhere", 64, &["nowhere"]),
        ("health http://127.0.0.1:9 --timeout 5M", 64, &["--timeout", "1 to 3600"]),
        ("health http://127.0.0.1:9", 69, &["127.0.0.1:9"]),
        ("verify {f}/none", 64, &["{f}/none"]),
        ("verify {f}/folder", 1, &[]),
        ("bench env", 64, &["magex-bench -- env"]),
        ("learner --resume --resume-or-create", 64, &["--resume", "--resume-or-create"]),
        ("learner --resume --out {f}/none --listen 127.0.0.1:0", 64, &["{f}/none"]),
        ("learner --out {f}/run --listen 127.0.0.1:0", 73, &["{f}/run", "--resume"]),
        ("learner --out /proc/new --listen 127.0.0.1:0", 73, &["/proc/new"]),
        ("learner --out new --listen 0.0.0.0:0", 64, &["--listen 0.0.0.0:0", "--insecure"]),
        ("learner --out new --listen 127.0.0.1:0 --http nowhere", 64, &["--http"]),
        ("learner --tls-cert {f}/noise", 64, &["--tls-key"]),
        ("learner --client-ca {f}/noise", 64, &["--tls-cert"]),
        ("learner --identities {f}/no-identity.toml", 64, &["identity"]),
        ("learner --identities {f}/half-identity.toml", 64, &["--identities", "line 1", "role"]),
        ("learner --identities {f}/role.toml", 64, &["--identities", "line 3", "boss"]),
        ("actor --token-file {f}/empty", 64, &["--token-file {f}/empty"]),
        ("actor --token-file {f}/token --learner http://10.1.2.3:1", 64, &["--learner", "unencrypted"]),
        ("actor --threads 100000", 64, &["--threads", "1 to 4096"]),
        ("actor --threads 0", 64, &["--threads"]),
        ("actor --learner ''", 64, &["--learner"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/none", 64, &["{f}/none"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/text", 64, &["{f}/text", "not a weights file"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/empty", 64, &["{f}/empty", "not a weights file"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/folder", 64, &["{f}/folder"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/run --config {f}/agents-only.toml", 64, &["task.name"]),
        ("commander --config {f}/run/config.toml", 64, &["--weights"]),
        ("commander --model {f}/none", 64, &["{f}/none"]),
        ("commander --mission-hours 9000", 64, &["--mission-hours", "1 to 8760"]),
        ("commander --listen 127.0.0.1:0 --data {f}/noise", 73, &["--data {f}/noise"]),
        ("commander --listen 127.0.0.1:0 --data /proc/new", 73, &["--data /proc/new"]),
        ("commander --listen 127.0.0.1:0 --otlp nowhere", 64, &["--otlp"]),
    ]
    .iter()
    .map(|(line, code, names)| row(line, *code, names))
    .collect();
    rows.extend([
        with("RUST_LOG", "a=loud", row("actor", 64, &["RUST_LOG", "a=loud"])),
        with("RUST_LOG", "=,=", row("eval {f}/run --episodes 1", 64, &["RUST_LOG"])),
        with("MAGEX_TOKEN", "two words", row("actor --learner http://127.0.0.1:9", 64, &["MAGEX_TOKEN"])),
        with("MAGEX_TLS_CERT", "{f}/noise", row("commander", 64, &["MAGEX_TLS_CERT", "--tls-key"])),
        with("MAGEX_TLS_CA", "{f}/none", row("health https://127.0.0.1:9", 64, &["{f}/none"])),
        with("MAGEX_RESUME", "true", row("learner --resume-or-create", 64, &["MAGEX_RESUME", "--resume-or-create"])),
        with("MAGEX_LOG_FORMAT", "json", row("train --agents five", 64, &["\"exit_code\":64", "--agents"])),
        with(
            "MAGEX_LOG_FORMAT",
            "json",
            row("assign --random 2 --connect http://127.0.0.1:9", 69, &["\"level\":\"ERROR\""]),
        ),
    ]);
    rows
}

pub(crate) fn prepare(folder: &Path) {
    let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).unwrap();
    std::fs::create_dir(folder.join("folder")).unwrap();
    std::fs::write(folder.join("noise"), [0xff, 0xfe, 0x00, 0x80, b'x']).unwrap();
    for (name, text) in [
        ("empty", ""),
        ("text", "# A text that is no weights file.\n"),
        ("token", "secret"),
        ("agents-only.toml", "[task]\nagents = 5"),
        ("ring.toml", "[task]\nname = 'drones'\nagents = 5\nspawn = 'ring'"),
        ("open-table.toml", "\n[run"),
        ("no-section.toml", "run = 5"),
        ("twice.toml", "[run]\nseed = 1\nseed = 2"),
        ("huge.toml", "[run]\nseed = 9223372036854775808"),
        ("beyond.toml", "[run]\nseed = 99999999999999999999999999999999999999999999"),
        ("renamed.toml", "[mappo]\nclip = 0.1"),
        ("other-section.toml", "[task]\nname = 'push-ball'\nagents = 5\nspawn = 'uniform'\n[task.drones]\ntilt = 1"),
        ("strange.toml", "[strange]\nkey = 1"),
        ("shards.toml", "[collect]\nepisodes_per_iteration = 4\nshards_per_iteration = 3"),
        ("chunk.toml", "[mappo]\nchunk_length = 7"),
        ("ranking.toml", "[commander]\nkind = 'ranking'"),
        ("no-identity.toml", ""),
        ("half-identity.toml", "[[identity]]\nname = 'a'"),
        ("role.toml", "[[identity]]\nname = 'a'\nrole = 'boss'\ntoken_sha256 = 'a'"),
        (
            "tiny.toml",
            "[run]\nmax_steps = 240\neval_episodes = 4\nfinal_episodes = 4\n[task]\nname = 'simple-spread'\nagents = 5\n\
             spawn = 'uniform'\n[executor]\nkind = 'local'\n[collect]\nepisodes_per_iteration = 4\n[mappo]\nepochs = 1",
        ),
    ] {
        write(name, text);
    }
    let own = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    write("cert.pem", &own.cert.pem());
    write("key.pem", &own.signing_key.serialize_pem());
    let train = ["train", "tiny.toml", "--in-process", "--http", "off", "--out", "run"];
    let trained = Command::new(binary()).args(train).current_dir(folder).output().unwrap();
    assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    for copy in ["broken", "headless"] {
        let copied = Command::new("cp").args(["-r", "run", copy]).current_dir(folder).status();
        assert!(copied.unwrap().success());
    }
    std::fs::remove_file(folder.join("headless/config.toml")).unwrap();
    std::fs::remove_file(folder.join("broken/summary.json")).unwrap();
    for checkpoint in std::fs::read_dir(folder.join("broken/checkpoints")).unwrap() {
        std::fs::write(checkpoint.unwrap().path().join("weights.safetensors"), "x").unwrap();
    }
}
