//! Keeps error statuses within the header sizes that clients accept; beyond, many report an internal error instead.

use tonic::codegen::http::{HeaderMap, HeaderValue};

/// Longest `grpc-message`, bytes as sent (percent-encoded).
const MESSAGE: usize = 2048;

/// Longest `grpc-status-details-bin`, bytes as sent. The details repeat the message.
const DETAILS: usize = 4096;

/// `…`, percent-encoded.
const MORE: &[u8] = b"%E2%80%A6";

/// Cuts a long message at a character boundary and drops details that are too long.
pub(super) fn truncate_status(headers: &mut HeaderMap) {
    if let Some(message) = headers.get_mut("grpc-message")
        && message.len() > MESSAGE
    {
        let bytes = message.as_bytes();
        let mut cut = MESSAGE - MORE.len();
        while cut > 0 && !ends_at(bytes, cut) {
            cut -= 1;
        }
        let short = [&bytes[..cut], MORE].concat();
        *message = HeaderValue::from_bytes(&short).unwrap_or_else(|_| HeaderValue::from_static("too long"));
    }
    if headers.get("grpc-status-details-bin").is_some_and(|details| details.len() > DETAILS) {
        headers.remove("grpc-status-details-bin");
    }
}

/// Whether a character ends before this byte: no escape is cut, and the next byte does not continue a character.
fn ends_at(bytes: &[u8], cut: usize) -> bool {
    let in_escape = (1..=2).any(|back| cut >= back && bytes[cut - back] == b'%');
    let continued = bytes[cut] == b'%' && matches!(bytes.get(cut + 1), Some(b'8' | b'9' | b'A' | b'B' | b'a' | b'b'));
    !in_escape && !continued
}

#[cfg(test)]
mod tests {
    use super::*;
    use tonic::{Code, Status};
    use tonic_types::{ErrorDetails, StatusExt as _};

    fn sent(status: Status) -> HeaderMap {
        let mut headers = status.into_http::<tonic::body::Body>().into_parts().0.headers;
        truncate_status(&mut headers);
        headers
    }

    #[test]
    fn a_long_message_ends_with_a_whole_character() {
        for filler in ["a", "é", "漢", "💡", "% ", "a漢"] {
            for shift in 0..12 {
                let text = format!("{}{}", "x".repeat(shift), filler.repeat(3000));
                let headers = sent(Status::not_found(text.clone()));
                assert!(headers["grpc-message"].len() <= MESSAGE);
                let status = Status::from_header_map(&headers).unwrap();
                let kept = status.message().strip_suffix('…').unwrap();
                assert!(text.starts_with(kept) && !kept.is_empty(), "{kept}");
            }
        }
    }

    #[test]
    fn short_messages_are_unchanged_and_only_long_details_are_dropped() {
        let with = |field: &str| {
            let details = ErrorDetails::with_bad_request_violation(field, "no");
            sent(Status::with_error_details(Code::InvalidArgument, "short", details))
        };
        let status = Status::from_header_map(&with("agents.dims")).unwrap();
        assert_eq!(status.get_details_bad_request().unwrap().field_violations[0].field, "agents.dims");
        let status = Status::from_header_map(&with(&"f".repeat(5000))).unwrap();
        assert!(status.message() == "short" && status.details().is_empty());
    }
}
