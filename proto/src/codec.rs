//! How messages are put into frames: as protobuf, followed by a checksum of their bytes.
//!
//! TCP's own checksum lets some damage pass, and the damaged bytes could be a number of a run: the shard of a lease, a goal,
//! the seed. The checksum is a field (the highest that protobuf has) behind the last one of every message. Programs that
//! do not know it skip it as an unknown field, and messages without it are accepted as they are.

use crate::apart::apart;
use crate::elements;
use bytes::{Buf as _, BufMut as _, Bytes};
use prost::Message;
use std::cell::RefCell;
use std::marker::PhantomData;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

/// Field 536870911, fixed32.
const TAG: [u8; 5] = [0xfd, 0xff, 0xff, 0xff, 0x0f];

/// The tag, and the CRC-32C of all bytes before it, little-endian.
const TRAILER: usize = TAG.len() + 4;

/// Protobuf with a checksum; what the generated clients and servers use.
#[derive(Debug, Clone, Copy)]
pub struct CheckedCodec<T, U> {
    types: PhantomData<(T, U)>,
}

impl<T, U> Default for CheckedCodec<T, U> {
    fn default() -> Self {
        Self { types: PhantomData }
    }
}

/// A message of a service; implemented for every input and output of every method, from the descriptor.
pub trait Sent {
    /// Whether callers send it: what is wrong with it is then theirs to put right.
    const BY_CALLER: bool;
}

impl<T, U> Codec for CheckedCodec<T, U>
where
    T: Message + Send + 'static,
    U: Message + Default + Sent + Send + 'static,
{
    type Encode = T;
    type Decode = U;
    type Encoder = CheckedCodec<T, U>;
    type Decoder = CheckedCodec<T, U>;

    fn encoder(&mut self) -> Self::Encoder {
        Self::default()
    }

    fn decoder(&mut self) -> Self::Decoder {
        Self::default()
    }
}

impl<T: Message, U> Encoder for CheckedCodec<T, U> {
    type Item = T;
    type Error = Status;

    fn encode(&mut self, item: T, frame: &mut EncodeBuf<'_>) -> Result<(), Status> {
        SCRATCH.with_borrow_mut(|scratch| {
            scratch.clear();
            item.encode(scratch).map_err(|error| Status::internal(error.to_string()))?;
            frame.reserve(scratch.len() + TRAILER);
            frame.put_slice(scratch);
            frame.put_slice(&TAG);
            frame.put_u32_le(crc32c::crc32c(scratch));
            scratch.clear();
            scratch.shrink_to(MAX_SCRATCH);
            Ok(())
        })
    }
}

thread_local! {
    /// A frame does not show what was written to it, so that the checksum needs the bytes elsewhere first. Kept from one
    /// message to the next: a new megabyte each time costs more in page faults than the copy.
    static SCRATCH: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
}

/// What a thread keeps, bytes.
const MAX_SCRATCH: usize = 2 << 20;

impl<T, U: Message + Default + Sent + 'static> Decoder for CheckedCodec<T, U> {
    type Item = U;
    type Error = Status;

    fn decode(&mut self, frame: &mut DecodeBuf<'_>) -> Result<Option<U>, Status> {
        let bytes = frame.copy_to_bytes(frame.remaining());
        apart(bytes.len(), || read(bytes)).map(Some)
    }
}

fn read<U: Message + Default + Sent + 'static>(bytes: Bytes) -> Result<U, Status> {
    let bytes = checked(bytes)?;
    if !U::BY_CALLER {
        return U::decode(bytes).map_err(|error| Status::internal(error.to_string()));
    }
    elements::check::<U>(&bytes).map_err(|limit| {
        let problem = format!("more than the {limit} elements that a request of this length may have; send fewer");
        invalid("request", problem)
    })?;
    U::decode(bytes).map_err(|error| unreadable(&error.to_string()))
}

fn invalid(field: &str, problem: String) -> Status {
    let details = ErrorDetails::with_bad_request_violation(field, &*problem);
    Status::with_error_details(Code::InvalidArgument, format!("{field}: {problem}"), details)
}

/// What the decoder says, `…: Inner.field: Outer.field: problem`, as path and problem: prost shows the path only here.
fn unreadable(error: &str) -> Status {
    let mut path = Vec::new();
    let mut problem = error.strip_prefix("failed to decode Protobuf message: ").unwrap_or(error);
    while let Some((place, rest)) = problem.split_once(": ") {
        match place.split_once('.') {
            Some((message, field)) if !message.contains(' ') && !field.contains(' ') => path.push(field),
            _ => break,
        }
        problem = rest;
    }
    path.reverse();
    let field = if path.is_empty() { "request".to_owned() } else { path.join(".") };
    invalid(&field, problem.to_owned())
}

/// The message without its checksum, if it has one.
fn checked(bytes: Bytes) -> Result<Bytes, Status> {
    let Some(length) = bytes.len().checked_sub(TRAILER) else { return Ok(bytes) };
    let (message, trailer) = bytes.split_at(length);
    let Some(claimed) = trailer.strip_prefix(&TAG) else { return Ok(bytes) };
    let actual = crc32c::crc32c(message);
    if actual.to_le_bytes() != *claimed {
        return Err(Status::data_loss(format!(
            "the message arrived damaged: its checksum is {actual:08x}, not what its sender says"
        )));
    }
    Ok(bytes.slice(..length))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::v1::Ack;

    fn framed(message: &Ack) -> Vec<u8> {
        let mut bytes = message.encode_to_vec();
        let sum = crc32c::crc32c(&bytes);
        bytes.extend(TAG);
        bytes.extend(sum.to_le_bytes());
        bytes
    }

    #[test]
    fn every_flipped_bit_of_a_message_is_noticed() {
        let message = Ack { lease_id: 7, verdict: 1, reason: "because".into() };
        let bytes = framed(&message);
        let whole = checked(bytes.clone().into()).unwrap();
        assert_eq!(Ack::decode(whole).unwrap(), message);
        let length = bytes.len() - TRAILER;
        for bit in (0..8 * length).chain(8 * (bytes.len() - 4)..8 * bytes.len()) {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(checked(flipped.into()).unwrap_err().code(), tonic::Code::DataLoss, "bit {bit}");
        }
    }

    #[test]
    fn an_unreadable_request_is_the_callers_error_and_names_the_field() {
        assert_eq!([crate::v1::AssignRequest::BY_CALLER, crate::v1::AssignResponse::BY_CALLER], [true, false]);
        for (bytes, field) in [
            // A number where a message belongs; within a message; a name that is no text; an end that is missing.
            (&[0x08, 0x01][..], "agents"),
            (&[0x0a, 0x02, 0x0a, 0x05], "agents.dims"),
            (&[0x1a, 0x01, 0xff], "agent_ids"),
            (&[0xff], "request"),
        ] {
            let error = crate::v1::AssignRequest::decode(bytes).unwrap_err().to_string();
            let status = unreadable(&error);
            assert_eq!(status.code(), Code::InvalidArgument);
            let details = status.get_details_bad_request().unwrap();
            assert_eq!(details.field_violations[0].field, field, "{error}");
        }
    }

    #[test]
    fn a_peer_without_checksums_reads_and_is_read() {
        let message = Ack { lease_id: 7, verdict: 1, reason: "because".into() };
        assert_eq!(Ack::decode(framed(&message).as_slice()).unwrap(), message);
        assert_eq!(Ack::decode(checked(message.encode_to_vec().into()).unwrap()).unwrap(), message);
        assert_eq!(checked(Bytes::new()).unwrap(), Bytes::new());
    }
}
