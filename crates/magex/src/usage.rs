//! Errors of the command line: what was given, where it was given (an option or a variable of the environment), and what to
//! write.

use crate::output::fatal;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, Command};
use magex_runtime::exit;
use magex_runtime::telemetry::{self, LogFormat};
use std::error::Error as _;
use std::ffi::OsString;
use std::process::ExitCode;

/// A suggestion shares at least this part of its letters with what was written.
const SIMILAR: f64 = 0.8;

/// Every option that takes a value takes negative numbers, too: the refusal then names the range.
pub fn taking_negative_numbers(command: Command) -> Command {
    let negative = |arg: Arg| if arg.get_action().takes_values() { arg.allow_negative_numbers(true) } else { arg };
    command.mut_args(negative).mut_subcommands(move |sub| sub.mut_args(negative))
}

/// The options whose values come from variables of the environment.
#[derive(Debug, Default)]
pub struct FromEnvironment(Vec<(String, String)>);

impl FromEnvironment {
    /// Those of the subcommand that `arguments` call.
    pub fn of(command: &Command, arguments: &[OsString]) -> Self {
        let called = arguments.iter().skip(1).find_map(|argument| command.find_subcommand(argument));
        let set = |arg: &Arg| {
            let (variable, option) = (arg.get_env()?, format!("--{}", arg.get_long()?));
            let given = |argument: &OsString| {
                let text = argument.to_string_lossy();
                text.strip_prefix(&option).is_some_and(|rest| rest.is_empty() || rest.starts_with('='))
            };
            let from_environment =
                std::env::var_os(variable).is_some_and(|value| !value.is_empty()) && !arguments.iter().any(given);
            from_environment.then(|| (option, variable.to_string_lossy().into_owned()))
        };
        Self(called.unwrap_or(command).get_arguments().filter_map(set).collect())
    }

    /// A message in which these options have the names of their variables.
    pub fn named(&self, message: &str) -> String {
        let part = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        self.0.iter().fold(message.to_owned(), |text, (option, variable)| {
            let mut out = String::new();
            let mut rest = text.as_str();
            while let Some(at) = rest.find(option.as_str()) {
                let end = at + option.len();
                let whole = !rest[..at].ends_with(part) && !rest[end..].starts_with(part);
                out += &rest[..at];
                out += if whole { variable } else { option };
                rest = &rest[end..];
            }
            out + rest
        })
    }
}

/// Reports an error of the command line parser; help and version count as success.
pub fn report(command: &Command, arguments: &[OsString], error: &clap::Error) -> ExitCode {
    if !error.use_stderr() {
        // If printing fails there is no other place to report it.
        let _ = error.print();
        return ExitCode::from(exit::OK);
    }
    log_format(arguments).apply();
    if error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand && !telemetry::is_json() {
        let _ = error.print();
        return ExitCode::from(exit::USAGE);
    }
    let environment = FromEnvironment::of(command, arguments);
    let mut text = environment.named(&explain(error));
    let together = matches!(error.kind(), ErrorKind::MissingRequiredArgument | ErrorKind::ArgumentConflict);
    if together && !environment.0.is_empty() {
        let names: Vec<&str> = environment.0.iter().map(|(_, variable)| variable.as_str()).collect();
        text += &format!("; the environment sets {}", names.join(", "));
    }
    let called = arguments.iter().skip(1).find_map(|argument| Some(command.find_subcommand(argument)?.get_name()));
    let program = command.get_name();
    let help = called.map_or_else(|| format!("{program} --help"), |name| format!("{program} {name} --help"));
    fatal(&format!("{text} (more: {help})"), exit::USAGE, arguments.iter().any(|argument| argument == "--json"));
    ExitCode::from(exit::USAGE)
}

/// The format of log lines, as far as it can be told from a command line that is not understood.
fn log_format(arguments: &[OsString]) -> LogFormat {
    let option = "--log-format";
    let texts: Vec<String> = arguments.iter().map(|argument| argument.to_string_lossy().into_owned()).collect();
    let separate = texts.iter().position(|text| text == option).and_then(|at| texts.get(at + 1).cloned());
    let joined = || texts.iter().find_map(|text| Some(text.strip_prefix(option)?.strip_prefix('=')?.to_owned()));
    let variable = || std::env::var("MAGEX_LOG_FORMAT").ok();
    let json = separate.or_else(joined).or_else(variable).is_some_and(|text| text.trim().eq_ignore_ascii_case("json"));
    if json { LogFormat::Json } else { LogFormat::Text }
}

fn explain(error: &clap::Error) -> String {
    let text = |kind: ContextKind| match error.get(kind) {
        Some(ContextValue::String(text)) => text.clone(),
        Some(ContextValue::Strings(texts)) => texts.join(", "),
        Some(ContextValue::StyledStr(text)) => text.to_string(),
        _ => String::new(),
    };
    let (arg, value) = (text(ContextKind::InvalidArg), text(ContextKind::InvalidValue));
    let option = arg.split(' ').next().unwrap_or_default();
    match error.kind() {
        ErrorKind::InvalidValue if value.is_empty() => format!("{option}: its value is missing; write {arg}"),
        ErrorKind::InvalidValue => {
            format!("{option}: '{value}' is unknown; use {}", text(ContextKind::ValidValue))
        }
        ErrorKind::ValueValidation => match error.source() {
            Some(problem) => format!("{option}: {problem}"),
            None => format!("{option}: '{value}' cannot be used"),
        },
        ErrorKind::UnknownArgument if option.starts_with('-') => {
            format!("there is no option {option}{}", suggestion(option, &text(ContextKind::SuggestedArg)))
        }
        ErrorKind::UnknownArgument => format!("'{arg}' is one argument too many"),
        ErrorKind::InvalidSubcommand => {
            let name = text(ContextKind::InvalidSubcommand);
            format!("there is no command '{name}'{}", suggestion(&name, &text(ContextKind::SuggestedSubcommand)))
        }
        ErrorKind::MissingRequiredArgument => format!("{arg} is missing"),
        ErrorKind::ArgumentConflict => {
            let prior = text(ContextKind::PriorArg);
            let prior = prior.split(' ').next().unwrap_or_default();
            let both = if prior.is_empty() || prior == option { String::new() } else { format!(" and {prior}") };
            let problem = if both.is_empty() { "is given twice" } else { "cannot be used together" };
            format!("{option}{both}: {problem}; leave one out")
        }
        ErrorKind::TooManyValues => format!("{option} takes no value; '{value}' must be left out"),
        ErrorKind::InvalidUtf8 => "an argument is no text (UTF-8)".to_owned(),
        _ => error.to_string().trim_start_matches("error: ").trim().to_owned(),
    }
}

/// A name that differs in little from the one that was written; similar words that mean something else would mislead.
fn suggestion(written: &str, similar: &str) -> String {
    let close = |name: &&str| strsim::normalized_damerau_levenshtein(written, name) >= SIMILAR;
    similar.split(", ").find(close).map_or_else(String::new, |name| format!("; is {name} meant?"))
}
