//! `--environment`: the program that is the environment of a run with an external task, and what it says about itself.

use crate::failure::{coded, usage};
use anyhow::Context as _;
use magex_actor::environment::{EnvironmentError, EnvironmentSource, Environments, TIMEOUT_SECONDS};
use magex_core::config::RunConfig;
use magex_core::task::{ExternalConfig, TaskName};
use magex_runtime::security::ClientArgs;
use magex_runtime::{exit, options};
use std::sync::Arc;
use std::time::Duration;
use toml::{Table, Value};

/// Where the environment comes from. It is never read from a configuration: a file from elsewhere starts no program.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
#[command(next_help_heading = "External environment")]
pub(crate) struct EnvironmentArgs {
    /// Program that is the environment (task "external"): a command, which is started for every rollout thread, or the address
    /// of one that runs (http://, https://, unix:PATH).
    #[arg(long, value_name = "COMMAND")]
    pub(crate) environment: Option<String>,
    /// Seconds that it has for its start and for each step.
    #[arg(long, value_name = "SECONDS", default_value_t = TIMEOUT_SECONDS, value_parser = options::whole::<u64>(1, 86_400))]
    pub(crate) environment_timeout: u64,
}

/// What an actor of ours reads to call an environment elsewhere.
pub(crate) const VARIABLES: [&str; 3] = ["MAGEX_TLS_CA", "MAGEX_TOKEN_FILE", "MAGEX_TOKEN"];

/// An environment that was found, and what it says about itself.
#[derive(Debug, Clone)]
pub(crate) struct Described {
    external: ExternalConfig,
    /// Steps after which it ends an episode by itself; 0 if it does not say.
    steps_max: u32,
}

impl EnvironmentArgs {
    /// The source of the environments, if there is one.
    pub(crate) fn source(&self) -> anyhow::Result<Option<EnvironmentSource>> {
        let Some(text) = &self.environment else { return Ok(None) };
        // The token and the CA of a service elsewhere come from the environment variables that every client reads.
        let file = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(Into::into);
        let client = ClientArgs { tls_ca: file("MAGEX_TLS_CA"), token_file: file("MAGEX_TOKEN_FILE") };
        let settings = client.read(None, false)?;
        let timeout = Duration::from_secs(self.environment_timeout.max(1));
        Ok(Some(EnvironmentSource::new(text, &settings, timeout)?))
    }

    /// Starts one and asks it what it is.
    pub(crate) fn describe(&self) -> anyhow::Result<Option<Described>> {
        let Some(source) = self.source()? else { return Ok(None) };
        let environment = source.open().map_err(unavailable)?;
        let (external, steps_max) = (environment.description().clone(), environment.steps_max());
        Ok(Some(Described { external, steps_max }))
    }

    /// The environments of a run.
    ///
    /// # Errors
    /// The run has an external task and no environment was given, or the reverse.
    pub(crate) fn of_run(&self, config: &RunConfig) -> anyhow::Result<Option<Arc<Environments>>> {
        match (config.task.external(), self.source()?) {
            (Ok(external), Some(source)) => Ok(Some(Arc::new(Environments::new(source, external)))),
            (Ok(external), None) => {
                let name = &external.environment;
                Err(usage(format!("--environment: the run's task is {name}, a program of its own; give its command")))
            }
            (Err(_), Some(_)) => Err(usage(format!(
                "--environment: the task is {}, which magex simulates itself; leave --environment out, or write name = \
                 \"external\"",
                config.task.name
            ))),
            (Err(_), None) => Ok(None),
        }
    }

    /// The options as an actor's arguments.
    pub(crate) fn arguments(&self) -> Vec<String> {
        let own = |text: &String| {
            let seconds = self.environment_timeout.to_string();
            vec!["--environment".to_owned(), text.clone(), "--environment-timeout".to_owned(), seconds]
        };
        self.environment.as_ref().map(own).unwrap_or_default()
    }
}

/// What cannot be reached has a code of its own.
pub(crate) fn unavailable(error: EnvironmentError) -> anyhow::Error {
    match error {
        EnvironmentError::Lost(_) => coded(exit::UNAVAILABLE, format!("--environment: {error}")),
        error => anyhow::Error::new(error).context("--environment"),
    }
}

impl Described {
    /// Whether it draws pictures.
    pub(crate) fn renders(&self) -> bool {
        self.external.renders
    }

    /// A configuration with the task that the environment is; text that is no TOML stays what it is.
    ///
    /// # Errors
    /// The file has another task.
    pub(crate) fn fill(&self, text: &str) -> anyhow::Result<String> {
        let Ok(mut file) = toml::from_str::<Table>(text) else { return Ok(text.to_owned()) };
        let task = file.entry("task").or_insert_with(|| Table::new().into());
        let Value::Table(task) = task else { return Ok(text.to_owned()) };
        let external = TaskName::External.to_string();
        match task.get("name") {
            Some(Value::String(name)) if *name == external => {}
            None => drop(task.insert("name".to_owned(), external.clone().into())),
            Some(name) => {
                return Err(usage(format!(
                    "--environment: task.name is {name}, which magex simulates itself; leave --environment out, or write \
                     name = \"external\""
                )));
            }
        }
        let agents = i64::try_from(self.external.agent_names.len()).context("task.agents")?;
        task.entry("agents").or_insert(agents.into());
        if self.steps_max > 0 {
            task.entry("horizon").or_insert(i64::from(self.steps_max).into());
        }
        if let Some(Value::Table(own)) = task.get(&external) {
            let own: ExternalConfig = own.clone().try_into().context("task.external")?;
            if let Some(key) = own.changed(&ExternalConfig {
                renders: own.renders,
                deterministic: own.deterministic,
                successes: own.successes,
                ..self.external.clone()
            }) {
                return Err(usage(format!(
                    "task.external.{key} is not what the environment says; start the environment that the file was made \
                     for, or remove [task.external]"
                )));
            }
        }
        task.insert(external, Value::try_from(&self.external)?);
        Ok(file.to_string())
    }
}
