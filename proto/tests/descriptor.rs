//! The contract, readable: a change of the wire shows in review as a change of `descriptor.txt`.
//! `UPDATE_EXPECT=1 cargo test -p magex-proto` rewrites it.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use prost::Message as _;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, EnumDescriptorProto, FieldDescriptorProto, FileDescriptorSet};
use std::fmt::Write as _;

fn kind(field: &FieldDescriptorProto) -> String {
    let name = match field.r#type() {
        Type::Message | Type::Enum => field.type_name().trim_start_matches(".magex.v1.").to_owned(),
        other => other.as_str_name().trim_start_matches("TYPE_").to_lowercase(),
    };
    match field.label() {
        Label::Repeated => format!("repeated {name}"),
        _ if field.proto3_optional() => format!("optional {name}"),
        _ => name,
    }
}

fn message(text: &mut String, message: &DescriptorProto) {
    writeln!(text, "message {}", message.name()).unwrap();
    for field in &message.field {
        let oneof = match field.oneof_index {
            Some(index) if !field.proto3_optional() => format!(" ({})", message.oneof_decl[index as usize].name()),
            _ => String::new(),
        };
        writeln!(text, "  {:>2} {}: {}{oneof}", field.number(), field.name(), kind(field)).unwrap();
    }
    assert!(message.nested_type.is_empty() && message.enum_type.is_empty(), "keep messages and enums at the top level");
}

fn enumeration(text: &mut String, item: &EnumDescriptorProto) {
    writeln!(text, "enum {}", item.name()).unwrap();
    for value in &item.value {
        writeln!(text, "  {:>2} {}", value.number(), value.name()).unwrap();
    }
}

fn listing() -> String {
    let set = FileDescriptorSet::decode(magex_proto::FILE_DESCRIPTOR_SET).unwrap();
    let mut text = String::new();
    for file in &set.file {
        writeln!(text, "file {} (package {})", file.name(), file.package()).unwrap();
        for service in &file.service {
            writeln!(text, "service {}", service.name()).unwrap();
            for method in &service.method {
                let stream = |on: bool, name: &str| {
                    format!("{}{}", if on { "stream " } else { "" }, name.trim_start_matches(".magex.v1."))
                };
                let input = stream(method.client_streaming(), method.input_type());
                let output = stream(method.server_streaming(), method.output_type());
                writeln!(text, "  {}({input}) returns ({output})", method.name()).unwrap();
            }
        }
        file.enum_type.iter().for_each(|item| enumeration(&mut text, item));
        file.message_type.iter().for_each(|item| message(&mut text, item));
        text.push('\n');
    }
    text
}

#[test]
fn the_contract_is_the_committed_one() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/descriptor.txt");
    let now = listing();
    if std::env::var_os("UPDATE_EXPECT").is_some() {
        std::fs::write(path, &now).unwrap();
    }
    let committed = std::fs::read_to_string(path).unwrap_or_default();
    assert!(
        now == committed,
        "the wire changed; fields are only ever added. Review, then rewrite with UPDATE_EXPECT=1:\n{now}"
    );
}

#[test]
fn everything_is_commented() {
    let set = FileDescriptorSet::decode(magex_proto::FILE_DESCRIPTOR_SET).unwrap();
    for file in &set.file {
        let info = file.source_code_info.as_ref().unwrap();
        let commented =
            |path: &[i32]| info.location.iter().any(|at| at.path == path && !at.leading_comments().is_empty());
        for (m, message) in file.message_type.iter().enumerate() {
            assert!(commented(&[4, m as i32]), "{}", message.name());
            for (f, field) in message.field.iter().enumerate() {
                assert!(commented(&[4, m as i32, 2, f as i32]), "{}.{}", message.name(), field.name());
            }
        }
        for (e, item) in file.enum_type.iter().enumerate() {
            for (v, value) in item.value.iter().enumerate() {
                assert!(commented(&[5, e as i32, 2, v as i32]), "{}", value.name());
            }
        }
        for (s, service) in file.service.iter().enumerate() {
            for (m, method) in service.method.iter().enumerate() {
                assert!(commented(&[6, s as i32, 2, m as i32]), "{}", method.name());
            }
        }
    }
}
