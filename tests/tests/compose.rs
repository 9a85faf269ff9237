//! The containers, for real: deploy/base, deploy/image and deploy/compose.yaml on a Docker engine. Nothing is pulled.
//!
//! Needs an engine, so it runs only where it is asked for: `cargo test -p magex-tests --test compose -- --ignored`, as
//! `.ci/run` does where there is one. What it measures it prints; times decide nothing.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "helpers of tests; measurements are printed"
)]

use magex_core::config::RunConfig;
use magex_tests::sandbox::{binary, wait_until};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

/// Between two looks at a run.
const LOOK: Duration = Duration::from_millis(300);

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// A command that succeeds; its standard output.
fn done(command: &mut Command) -> String {
    let Output { status, stdout, stderr } = command.output().unwrap();
    assert!(status.success(), "{command:?}: {status}\n{}{}", text(&stdout), text(&stderr));
    text(&stdout)
}

fn docker(line: &str) -> String {
    done(Command::new("docker").args(line.split(' ')))
}

/// One project of containers. Leaves nothing behind, however the test ends.
struct Project {
    name: String,
    folder: tempfile::TempDir,
    files: Vec<&'static str>,
    settings: Vec<(&'static str, String)>,
}

impl Project {
    fn new(what: &str, files: &[&'static str]) -> Self {
        let name = format!("magex-{what}-{}", std::process::id());
        let folder = tempfile::tempdir().unwrap();
        let image = done(Command::new(root().join("deploy/image")).arg(binary()).env("TAG", &name).env_remove("BASE"));
        println!("{}", image.trim());
        let settings = vec![
            ("MAGEX_IMAGE", name.clone()),
            // Any free port of this machine.
            ("MAGEX_PUBLISH_COMMANDER", String::new()),
            ("MAGEX_PUBLISH_PAGE", String::new()),
            ("MAGEX_LEASE_SECONDS", "5".to_owned()),
            ("MAGEX_LEARNER_CPUS", "1".to_owned()),
        ];
        Self { name, folder, files: files.to_vec(), settings }
    }

    fn set(&mut self, name: &'static str, value: impl Into<String>) {
        self.settings.retain(|(old, _)| *old != name);
        self.settings.push((name, value.into()));
    }

    /// The run that the learner works on from its next start.
    fn choose(&mut self, name: &str, config: &str) -> PathBuf {
        let file = self.folder.path().join(format!("{name}.toml"));
        std::fs::write(&file, config).unwrap();
        self.set("MAGEX_RUN", name);
        self.set("MAGEX_RUN_CONFIG", file.display().to_string());
        file
    }

    fn compose(&self, line: &str) -> String {
        done(&mut self.composing(line))
    }

    fn composing(&self, line: &str) -> Command {
        let plugin = Command::new("docker").args(["compose", "version"]).output().is_ok_and(|o| o.status.success());
        let mut command = Command::new(if plugin { "docker" } else { "docker-compose" });
        if plugin {
            command.arg("compose");
        }
        for file in &self.files {
            command.arg("-f").arg(root().join("deploy").join(file));
        }
        command.args(["-p", &self.name]).args(line.split(' ')).envs(self.settings.iter().cloned());
        command
    }

    fn containers(&self, service: &str) -> Vec<String> {
        let project = format!("label=com.docker.compose.project={}", self.name);
        let filter = format!("label=com.docker.compose.service={service}");
        let ids = docker(&format!("ps --quiet --filter {project} --filter {filter}"));
        ids.lines().map(str::to_owned).collect()
    }

    fn container(&self, service: &str) -> String {
        self.containers(service).pop().unwrap_or_else(|| panic!("no container of {service} runs"))
    }

    fn health(&self) -> Vec<String> {
        let project = format!("label=com.docker.compose.project={}", self.name);
        let ids = docker(&format!("ps --all --quiet --filter {project}"));
        let of = |id| docker(&format!("inspect --format {{{{.Name}}}}={{{{.State.Health.Status}}}} {id}"));
        ids.lines().map(|id| of(id).trim().to_owned()).collect()
    }

    fn wait_for_health(&self, containers: usize) {
        wait_until(&format!("{containers} healthy containers"), || {
            let health = self.health();
            health.len() == containers && health.iter().all(|one| one.ends_with("=healthy"))
        });
    }

    /// A file of the run, if it is there by now.
    fn file(&self, run: &str, name: &str) -> Option<String> {
        let to = self.folder.path().join("copy");
        let learner = self.containers("learner").pop()?;
        let from = format!("{learner}:/data/{run}/{name}");
        let copied = Command::new("docker").arg("cp").arg(from).arg(&to).output().unwrap();
        copied.status.success().then(|| std::fs::read_to_string(to).unwrap())
    }

    fn iterations(&self, run: &str) -> usize {
        self.file(run, "metrics.jsonl").unwrap_or_default().lines().count()
    }

    fn wait_for_iterations(&self, run: &str, iterations: usize) {
        wait_until(&format!("{iterations} iterations of {run}"), || {
            // Copying out of a container takes a processor that the containers could use.
            std::thread::sleep(LOOK);
            self.iterations(run) >= iterations
        });
    }

    fn summary(&self, run: &str) -> serde_json::Value {
        wait_until(&format!("the end of {run}"), || {
            std::thread::sleep(LOOK);
            self.file(run, "summary.json").is_some()
        });
        serde_json::from_str(&self.file(run, "summary.json").unwrap()).unwrap()
    }

    /// How often the learner has greeted an actor, over all its starts.
    fn greetings(&self) -> usize {
        let output = Command::new("docker").args(["logs", &self.container("learner")]).output().unwrap();
        text(&output.stderr).matches("actor joined").count()
    }

    /// What there is of this project.
    fn left(&self) -> String {
        let filter = format!("label=com.docker.compose.project={}", self.name);
        let of = |what: &str| docker(&format!("{what} --quiet --filter {filter}"));
        [of("ps --all"), of("volume ls"), of("network ls")].concat()
    }
}

impl Drop for Project {
    fn drop(&mut self) {
        if std::thread::panicking() {
            for service in ["learner", "commander", "actor"] {
                for id in self.containers(service) {
                    let logs = Command::new("docker").args(["logs", "--tail", "30", &id]).output().unwrap();
                    println!("{service} {id}: {}{}", text(&logs.stdout), text(&logs.stderr));
                }
            }
        }
        // A second failure would hide the first.
        let _ = self.composing("--profile observe down --volumes --remove-orphans --timeout 12").output();
        let _ = Command::new("docker").args(["image", "rm", "--force", &self.name]).output();
    }
}

/// The same configuration in one process of this machine.
fn in_process(config: &Path) -> String {
    let out = config.with_extension("run");
    let mut command = Command::new(binary());
    command.arg("train").arg(config).args(["--in-process", "--json", "--out"]).arg(out);
    let line = done(&mut command);
    let result: serde_json::Value = serde_json::from_str(line.lines().last().unwrap()).unwrap();
    result["weights_sha256"].as_str().unwrap().to_owned()
}

const SPREAD: &str = include_str!("../../deploy/configs/spread-20.toml");

#[test]
#[ignore = "needs a Docker engine; .ci/run runs it where there is one"]
fn the_cluster_trains_scales_and_survives_and_learns_the_same_bits() {
    let mut project = Project::new("cluster", &["compose.yaml"]);

    // Up, and to the target.
    let file = project.choose("target", SPREAD);
    let clock = Instant::now();
    project.set("MAGEX_ACTORS", "2");
    project.compose("up --detach");
    project.wait_for_health(4);
    println!("up to all healthy: {:.1} s", clock.elapsed().as_secs_f64());
    let summary = project.summary("target");
    println!("spread-20 to its target: {:.1} s after up", clock.elapsed().as_secs_f64());
    assert_eq!(summary["target_reached"], true);
    assert_eq!(summary["weights_sha256"], in_process(&file), "with 2 actors, undisturbed");

    // Another run in the same cluster: the learner is a new one, actors and commander stay. Long enough to be disturbed.
    let mut config = RunConfig::from_toml(SPREAD).unwrap();
    (config.run.target_success, config.run.max_steps, config.run.checkpoint_every) = (2.0, 14 * 1200, 2);
    let file = project.choose("disturbed", &config.to_toml().unwrap());
    project.compose("up --detach");
    assert_eq!(project.containers("actor").len(), 2, "another up keeps the actors");
    project.wait_for_iterations("disturbed", 2);
    project.set("MAGEX_ACTORS", "4");
    project.compose("up --detach --no-recreate");
    assert_eq!(project.containers("actor").len(), 4);

    docker(&format!("kill {}", project.container("actor")));
    project.wait_for_iterations("disturbed", 4);
    let commander = project.container("commander");
    docker(&format!("kill {commander}"));
    std::thread::sleep(Duration::from_millis(500));
    docker(&format!("start {commander}"));

    // An operator kills the learner and starts it again.
    let learner = project.container("learner");
    project.wait_for_iterations("disturbed", 6);
    let (greeted, clock) = (project.greetings(), Instant::now());
    docker(&format!("kill {learner}"));
    docker(&format!("start {learner}"));
    wait_until("the actors to be back", || project.greetings() > greeted);
    println!("learner killed and started to training again: {:.1} s", clock.elapsed().as_secs_f64());

    // It dies by itself: the restart policy starts it again.
    project.wait_for_iterations("disturbed", 8);
    let process = docker(&format!("inspect --format {{{{.State.Pid}}}} {learner}"));
    let (greeted, clock) = (project.greetings(), Instant::now());
    let killed = Command::new("kill").args(["-KILL", process.trim()]).status().unwrap();
    if killed.success() {
        wait_until("the actors to be back", || project.greetings() > greeted);
        println!("learner died to training again: {:.1} s", clock.elapsed().as_secs_f64());
    } else {
        println!("the engine's processes are not ours to kill: the restart policy was not tried");
    }
    project.set("MAGEX_ACTORS", "1");
    project.compose("up --detach --no-recreate");
    assert_eq!(project.containers("actor").len(), 1);
    let disturbed = project.summary("disturbed");
    assert_eq!(disturbed["weights_sha256"], in_process(&file), "whatever happened in between");

    // A complete run that is started again stays as it is.
    docker(&format!("restart --time 12 {learner}"));
    project.wait_for_health(3);
    assert_eq!(project.summary("disturbed"), disturbed);

    // An off-policy learner in the same cluster, killed with its replay buffer half full.
    let file = project.choose("off-policy", OFF_POLICY);
    project.compose("up --detach");
    project.wait_for_iterations("off-policy", 3);
    let learner = project.container("learner");
    docker(&format!("kill {learner}"));
    docker(&format!("start {learner}"));
    assert_eq!(project.summary("off-policy")["weights_sha256"], in_process(&file), "QMIX, its learner killed");

    project.compose("down --volumes --timeout 12");
    assert_eq!(project.left(), "", "down leaves nothing behind");
}

/// QMIX for some seconds.
const OFF_POLICY: &str = "[run]\nalgorithm = 'qmix'\nmax_steps = 9600\neval_episodes = 4\nfinal_episodes = 6\n[task]\nname = 'simple-spread'\n\
    agents = 5\nspawn = 'uniform'\nreward_target = 'team'\n[executor]\nkind = 'flat'\nrecurrent = true\n[commander]\nkind = 'random'\n\
    [collect]\nepisodes_per_iteration = 8\n[qmix]\nbuffer_episodes = 64\nbatch_episodes = 8\nepisodes_per_gradient_step = 2\n";

/// A run of seconds.
const SHORT: &str = "[run]\nmax_steps = 1600\neval_episodes = 4\nfinal_episodes = 6\n[task]\nname = 'simple-spread'\nagents = 5\n\
    spawn = 'uniform'\n[executor]\nkind = 'local'\n[collect]\nepisodes_per_iteration = 4\n[mappo]\nepochs = 2\n";

#[test]
#[ignore = "needs a Docker engine; .ci/run runs it where there is one"]
fn with_certificates_the_cluster_accepts_known_clients_only() {
    let mut project = Project::new("tls", &["compose.yaml", "compose.tls.yaml"]);
    let certificates = project.folder.path().join("certificates");
    done(Command::new(root().join("deploy/certificates")).arg(&certificates));
    project.set("MAGEX_CERTIFICATES", certificates.display().to_string());
    let file = project.choose("short", SHORT);
    project.compose("up --detach");
    project.wait_for_health(4);
    assert_eq!(project.summary("short")["weights_sha256"], in_process(&file));

    let published = docker(&format!("port {} 7100", project.container("commander")));
    let (_, port) = published.lines().next().unwrap().rsplit_once(':').unwrap();
    let client = certificates.join("client");
    let assign = |certificate: bool, token: Option<&str>| {
        let mut command = Command::new(binary());
        command.args(["assign", "--random", "8", "--scheduler", "exact", "--connect"]);
        command.arg(format!("https://localhost:{port}")).env("MAGEX_TLS_CA", client.join("ca.crt"));
        if certificate {
            command.env("MAGEX_TLS_CERT", client.join("tls.crt")).env("MAGEX_TLS_KEY", client.join("tls.key"));
        }
        if let Some(token) = token {
            command.env("MAGEX_TOKEN", token);
        }
        command.output().unwrap()
    };
    let token = std::fs::read_to_string(client.join("token")).unwrap();
    let known = assign(true, Some(&token));
    assert!(known.status.success(), "{}", text(&known.stderr));
    let strangers =
        [(true, None, "no token"), (true, Some("guess"), "a wrong token"), (false, Some(&*token), "no certificate")];
    for (certificate, token, missing) in strangers {
        assert!(!assign(certificate, token).status.success(), "{missing}");
    }
    let plain = Command::new(binary()).args(["health", &format!("http://localhost:{port}")]).output().unwrap();
    assert_eq!(plain.status.code(), Some(69), "{}", text(&plain.stderr));
}
