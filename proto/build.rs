//! Generates the messages and services from `proto/` without an installed protoc.

use prost::Message as _;
use std::collections::BTreeMap;
use std::{error::Error, fs, path::PathBuf};

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let files = ["types", "learner", "commander", "policy", "environment"].map(|name| format!("magex/v1/{name}.proto"));
    let descriptors = protox::compile(files, ["proto"])?;
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    fs::write(out.join("magex_descriptor.bin"), descriptors.encode_to_vec())?;
    // Which side sends a message: the codec answers an unreadable request otherwise than an unreadable response.
    let methods = descriptors.file.iter().flat_map(|file| &file.service).flat_map(|service| &service.method);
    let messages: BTreeMap<&str, bool> =
        methods.flat_map(|method| [(method.input_type(), true), (method.output_type(), false)]).collect();
    let sides = messages.iter().map(|(name, request)| {
        let name = name.rsplit('.').next().unwrap_or(name);
        format!("impl crate::codec::Sent for {name} {{ const BY_CALLER: bool = {request}; }}\n")
    });
    fs::write(out.join("sent.rs"), sides.collect::<String>())?;
    tonic_prost_build::configure()
        .codec_path("crate::codec::CheckedCodec")
        .bytes(".")
        .emit_rerun_if_changed(false)
        .compile_fds(descriptors)?;
    Ok(())
}
