//! What went wrong, in headers that every client accepts: many refuse a list of headers longer than 8 or 16 KiB, and see an
//! internal error in the place of ours.

use tonic::codegen::http::{HeaderMap, HeaderValue};

/// Longest `grpc-message`, bytes as sent (percent-encoded).
const MESSAGE: usize = 2048;

/// Longest details, bytes as sent. They repeat the message; the field's path is short unless a caller made it long.
const DETAILS: usize = 4096;

/// `…`, percent-encoded.
const MORE: &[u8] = b"%E2%80%A6";

/// Cuts a long message where a character ends and leaves out details that are too long.
pub(super) fn shorten(headers: &mut HeaderMap) {
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

/// A character ends before this place: no escape is cut, and what follows does not continue one.
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
        shorten(&mut headers);
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
    fn short_ones_stay_and_details_go_only_when_they_are_long() {
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
