//! `magex export`

use crate::artifacts;
use crate::folder;
use crate::options::CommonOptions;
use magex_policy::export::Source;
use magex_policy::{onnx, torch};
use magex_runtime::exit;
use serde_json::json;
use std::path::PathBuf;

const AFTER_HELP: &str = "\
Examples:
  magex export RUN --format onnx                       RUN/policy.onnx
  magex export RUN --format onnx --out robot.onnx
  magex export RUN --format torch --out robot.py       and robot.safetensors

The inputs are raw positions, velocities and goals, for any batch, and for any \
    team size if the executor has none of its own; features and normalisation \
    are inside. docs/policy.md has the names and an example for each.

Exit codes: 0 success, 1 the policy cannot be exported, 64 wrong usage or \
    configuration, 73 the file cannot be written";

/// Write the policy of a run as one file for another runtime.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct ExportArgs {
    /// Run folder, or a weights file together with --config.
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Configuration of a weights file.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Format of the file.
    #[arg(long, value_enum, value_name = "FORMAT")]
    format: Format,
    /// The file [default: policy.onnx or policy.py in the run folder].
    #[arg(long, short, value_name = "PATH")]
    out: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Format {
    /// ONNX, opset 17: onnxruntime, tract and others.
    Onnx,
    /// A PyTorch module in one Python file, its weights beside it.
    Torch,
}

pub(crate) fn run(args: &ExportArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let trained = folder::load(&args.run, args.config.as_deref())?;
    let name = match args.format {
        Format::Onnx => "policy.onnx",
        Format::Torch => "policy.py",
    };
    let folder = trained.folder.clone().unwrap_or_default();
    let out = args.out.clone().unwrap_or_else(|| folder.join(name));
    artifacts::check(&out)?;
    trained.notes.iter().for_each(|text| tracing::warn!("{text}"));
    let source = Source::load(&trained.config, &trained.weights)?;
    let mut files = vec![out.clone()];
    match args.format {
        Format::Onnx => artifacts::write(&out, &onnx::write(&source)?)?,
        Format::Torch => {
            let weights = out.with_extension("safetensors");
            let beside = weights.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
            artifacts::write(&weights, &trained.weights)?;
            artifacts::write(&out, torch::write(&source, &beside).as_bytes())?;
            files.push(weights);
        }
    }
    let output = options.output();
    for file in &files {
        output.say(file.display().to_string());
    }
    output.result(&json!({
        "files": files, "weights_sha256": trained.sha256, "policy_sha256": source.policy_sha256(),
    }));
    Ok(exit::OK)
}
