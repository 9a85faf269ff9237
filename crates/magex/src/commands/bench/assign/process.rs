//! A commander as a process of its own.

use super::super::vitals::memory_mib;
use anyhow::{Context as _, anyhow};
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

/// Runs until dropped.
pub(super) struct ServiceProcess {
    child: Child,
    /// Where it listens.
    pub(super) url: String,
}

impl ServiceProcess {
    pub(super) fn start(weights: Option<&Path>) -> anyhow::Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("MAGEX_")) {
            command.env_remove(name);
        }
        command.args(["commander", "--listen", "127.0.0.1:0"]).stdin(Stdio::null()).stdout(Stdio::piped());
        if let Some(folder) = weights {
            command.arg("--weights").arg(folder);
        }
        let mut child = command.spawn()?;
        let mut line = String::new();
        let stdout = child.stdout.take().context("it has no standard output")?;
        BufReader::new(stdout).read_line(&mut line)?;
        let ready: serde_json::Value = serde_json::from_str(&line).unwrap_or_default();
        let address = ready["address"].as_str().ok_or_else(|| anyhow!("it did not start"))?;
        Ok(Self { url: format!("http://{address}"), child })
    }

    /// Memory now, MiB; 0 where the system does not tell.
    pub(super) fn mib(&self) -> f64 {
        memory_mib(self.child.id(), "VmRSS:")
    }

    /// Most memory so far, MiB; 0 where the system does not tell.
    pub(super) fn peak_mib(&self) -> f64 {
        memory_mib(self.child.id(), "VmHWM:")
    }
}

impl Drop for ServiceProcess {
    fn drop(&mut self) {
        // It keeps nothing: it may end as it is.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
