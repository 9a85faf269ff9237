//! Environments of other people: programs that an actor starts (or finds at an address) and calls over gRPC, one for each
//! rollout thread. The wire is `environment.proto`, the rules in words are in docs/environments.md.

mod connection;
mod description;
mod observed;
mod process;

pub use connection::Environment;
pub use observed::{Observed, Taken};

use description::difference;
use magex_core::task::ExternalConfig;
use magex_runtime::backoff::Backoff;
use magex_runtime::client::Settings;
use magex_runtime::exit::Failure;
use magex_runtime::sync::lock;
use std::path::PathBuf;
use std::sync::Mutex;
use std::time::Duration;

/// Why an environment gave no result.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EnvironmentError {
    /// It could not be started or reached, ended, or did not answer in time. It may be back soon.
    #[error("environment: {0}")]
    Lost(String),
    /// It raised an exception.
    #[error("environment: {0}")]
    Raised(String),
    /// It returned what its description does not allow.
    #[error("environment: {0}")]
    BrokeItsWord(String),
    /// It is not the environment of the run.
    #[error("environment: {0}; start the one that the run was made with, or make a run of this one")]
    Another(String),
    /// The run has an environment of its own, and none was given.
    #[error("environment: the run's task is {0}, a program of its own; give --environment COMMAND")]
    Missing(String),
}

impl EnvironmentError {
    /// Whether every attempt would end in this way.
    pub fn is_permanent(&self) -> bool {
        matches!(self, Self::Another(_) | Self::Missing(_))
    }
}

/// Where environments come from: `--environment`.
#[derive(Debug, Clone)]
pub struct EnvironmentSource {
    text: String,
    how: How,
    /// For the address of an https service, and its token.
    settings: Settings,
    /// Time for an answer, and for a start.
    timeout: Duration,
}

#[derive(Debug, Clone)]
enum How {
    /// Run by a shell, once for every thread.
    Command(String),
    /// A socket of a program that runs.
    Socket(PathBuf),
    /// The address of a service that runs.
    Url(String),
}

/// Default of `--environment-timeout`, seconds.
pub const TIMEOUT_SECONDS: u64 = 60;

impl EnvironmentSource {
    /// Reads the option: the address of a service (`http://`, `https://`, `unix:PATH`), or else a command.
    ///
    /// # Errors
    /// Wrong usage; the error names the option.
    pub fn new(text: &str, settings: &Settings, timeout: Duration) -> Result<Self, Failure> {
        let how = if let Some(path) = text.strip_prefix("unix:") {
            How::Socket(PathBuf::from(path.trim_start_matches("//")))
        } else if text.starts_with("http://") || text.starts_with("https://") {
            settings.check("--environment", text)?;
            How::Url(text.to_owned())
        } else if text.trim().is_empty() {
            return Err(Failure::usage("--environment: give a command, or the address of a service"));
        } else {
            How::Command(text.to_owned())
        };
        Ok(Self { text: text.to_owned(), how, settings: settings.clone(), timeout })
    }

    /// Starts or finds the environment, and asks it what it is.
    pub fn open(&self) -> Result<Environment, EnvironmentError> {
        Environment::open(&self.how, &self.settings, self.timeout)
    }

    /// The option's value.
    pub fn text(&self) -> &str {
        &self.text
    }
}

/// The environments of a process: as many as its threads use at one time.
#[derive(Debug)]
pub struct Environments {
    source: EnvironmentSource,
    expected: ExternalConfig,
    idle: Mutex<Vec<Environment>>,
}

/// Attempts at a shard whose environment was lost, and at one that it spoiled, before the shard is given back.
const ATTEMPTS_LOST: u32 = 4;
const ATTEMPTS_SPOILED: u32 = 2;

impl Environments {
    /// Of the environment that a run was made with.
    pub fn new(source: EnvironmentSource, expected: &ExternalConfig) -> Self {
        Self { source, expected: expected.clone(), idle: Mutex::default() }
    }

    /// Uses an environment that no other thread uses meanwhile. One that is lost is replaced and `work` is done again from its start;
    /// so it is, once, after an exception and a broken word.
    pub fn with<T>(
        &self,
        mut work: impl FnMut(&mut Environment) -> Result<T, EnvironmentError>,
    ) -> Result<T, EnvironmentError> {
        let (mut backoff, mut lost, mut spoiled) = (Backoff::default(), 0, 0);
        loop {
            let error = match self.take().and_then(|mut environment| match work(&mut environment) {
                Ok(result) => {
                    lock(&self.idle).push(environment);
                    Ok(result)
                }
                // Its state is not known: it ends here, with its process.
                Err(error) => Err(error),
            }) {
                Ok(result) => return Ok(result),
                Err(error) => error,
            };
            let (count, attempts) = match error {
                EnvironmentError::Lost(_) => (&mut lost, ATTEMPTS_LOST),
                EnvironmentError::Raised(_) | EnvironmentError::BrokeItsWord(_) => (&mut spoiled, ATTEMPTS_SPOILED),
                EnvironmentError::Another(_) | EnvironmentError::Missing(_) => return Err(error),
            };
            *count += 1;
            if *count >= attempts {
                return Err(error);
            }
            tracing::warn!(reason = %error, "the shard is begun again");
            std::thread::sleep(backoff.next_wait());
        }
    }

    /// Starts one before it is needed.
    pub fn prepare(&self) -> Result<(), EnvironmentError> {
        let environment = self.take()?;
        lock(&self.idle).push(environment);
        Ok(())
    }

    fn take(&self) -> Result<Environment, EnvironmentError> {
        if let Some(environment) = lock(&self.idle).pop() {
            return Ok(environment);
        }
        let environment = self.source.open()?;
        match difference(&self.expected, environment.description()) {
            None => Ok(environment),
            Some(difference) => Err(EnvironmentError::Another(difference)),
        }
    }
}
