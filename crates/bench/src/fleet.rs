//! Learner, commander and actors as processes of this machine, each of which can be measured, killed and started again.

use magex::supervise::service::{Running, Service};
use magex_core::config::RunConfig;
use std::path::Path;

/// The processes.
pub(crate) struct Fleet {
    learner: Service<'static>,
    running: Running,
    /// Commander and actors, with their names.
    pub(crate) others: Vec<(String, Running)>,
}

impl Fleet {
    /// Starts them all on a new run in this folder.
    pub(crate) async fn start(config: &RunConfig, place: &Path, actors: usize) -> anyhow::Result<Self> {
        let (given, out) = (place.join("given.toml"), place.join("run"));
        std::fs::create_dir_all(place)?;
        std::fs::write(&given, config.to_toml()?)?;
        let (given, out) = (given.display().to_string(), out.display().to_string());
        let first = ["learner", "--config", &given, "--out", &out, "--listen", "127.0.0.1:0"];
        let running = Service::new("learner", &first, place).start().await?;
        let (url, address) = (format!("http://{}", running.address), running.address.clone());
        let again = ["learner", "--resume", "--out", &out, "--listen", &address];
        let learner = Service::new("learner", &again, place);
        let commander = ["commander", "--learner", &url, "--listen", "127.0.0.1:0"];
        let commander = Service::new("commander", &commander, place).start().await?;
        let commander_url = format!("http://{}", commander.address);
        let mut others = vec![("commander".to_owned(), commander)];
        for number in 0..actors {
            let name = format!("actor-{number}");
            let options =
                ["actor", "--name", &name, "--learner", &url, "--commander", &commander_url, "--threads", "1"];
            let actor = Service::new(&name, &options, place).start().await?;
            others.push((name, actor));
        }
        Ok(Self { learner, running, others })
    }

    pub(crate) fn learner_url(&self) -> String {
        format!("http://{}", self.running.address)
    }

    /// Every process with its name.
    pub(crate) fn processes(&self) -> Vec<(String, u32)> {
        let others = self.others.iter().map(|(name, running)| (name.clone(), running.id()));
        std::iter::once(("learner".to_owned(), self.running.id())).chain(others).collect()
    }

    /// SIGKILL.
    pub(crate) async fn kill_learner(&mut self) -> anyhow::Result<()> {
        Ok(self.running.kill().await?)
    }

    /// Starts the learner from its checkpoint, where it listened before.
    pub(crate) async fn resume_learner(&mut self) -> anyhow::Result<()> {
        self.running = self.learner.start().await?;
        Ok(())
    }

    /// Stops them all.
    pub(crate) async fn stop(mut self) {
        for (_, other) in &mut self.others {
            other.stop().await;
        }
        self.running.stop().await;
    }
}
