//! What learner, actors and commander send each other.

use bytes::Bytes;
use magex_proto::convert::{decode_result, encode_result};
use magex_proto::parts::{Assembler, split};
use magex_proto::v1::{AssignBatchRequest, Part, WatchWeightsResponse};
use magex_proto::weights::{WeightsAssembler, sha256_hex};
use prost::Message;

/// Longest byte string that the target of parts puts together.
const LIMIT: usize = 1 << 16;

/// Messages, each after its length in two bytes.
fn messages<M: Message + Default>(bytes: &[u8]) -> impl Iterator<Item = M> {
    let mut rest = bytes;
    std::iter::from_fn(move || {
        let (length, tail) = rest.split_at_checked(2)?;
        let length = usize::from(u16::from_le_bytes([length[0], length[1]]));
        let (part, after) = tail.split_at_checked(length).unwrap_or((tail, &[]));
        rest = after;
        Some(M::decode(part))
    })
    .filter_map(Result::ok)
}

/// Gives a part the checksum of what it holds: damage gets past the first door.
fn mended(part: Part) -> Part {
    let crc32c = split(part.data.clone()).next().map_or(0, |first| first.crc32c);
    Part { crc32c, ..part }
}

/// Parts in any order and number. The first byte says whether their checksums are right.
pub fn parts(bytes: &[u8]) {
    let Some((&first, rest)) = bytes.split_first() else { return };
    let mut assembler = Assembler::new(LIMIT);
    for part in messages::<Part>(rest) {
        let part = if first & 1 == 1 { mended(part) } else { part };
        let announced = part.total_bytes;
        if let Ok(Some(whole)) = assembler.push(part) {
            assert!(whole.len() as u64 == announced && whole.len() <= LIMIT);
        }
    }
}

/// A stream of weights. The first byte says whether checksums and hashes are right.
pub fn weights(bytes: &[u8]) {
    let Some((&first, rest)) = bytes.split_first() else { return };
    let mut assembler = WeightsAssembler::default();
    for mut message in messages::<WatchWeightsResponse>(rest) {
        if first & 1 == 1
            && let Some(part) = message.part.take()
        {
            message.sha256 = sha256_hex(&part.data);
            message.part = Some(mended(part));
        }
        // Its first part would reserve what it announces.
        if message.part.as_ref().is_some_and(|part| part.total_bytes > 1 << 20) {
            continue;
        }
        let claimed = message.sha256.clone();
        if let Ok(Some((weights, _))) = assembler.push(message) {
            assert!(weights.sha256 == claimed && sha256_hex(&weights.bytes) == claimed);
        }
    }
}

/// A result of a shard: what is read can be written and read again.
pub fn result(bytes: &[u8]) {
    let Ok(delivery) = decode_result(Bytes::copy_from_slice(bytes)) else { return };
    let again = encode_result(&delivery.run_id, &delivery.weights_sha256, &delivery.result);
    match decode_result(again.clone()) {
        Ok(read) => assert_eq!(encode_result(&read.run_id, &read.weights_sha256, &read.result), again),
        Err(error) => panic!("what was read cannot be read again: {error}"),
    }
}

/// A request for the goals of a shard.
pub fn goals(bytes: &[u8]) {
    let Ok(message) = AssignBatchRequest::decode(bytes) else { return };
    match magex_proto::goals::GoalRequest::from_message(message) {
        Ok((request, _)) => {
            let b = request.shard.episodes as usize * request.stages;
            assert_eq!(request.agents.len(), b * request.agent_count * request.dims);
            assert_eq!(request.goals.len(), b * request.goal_count * request.dims);
        }
        Err(error) => assert!(!error.field.is_empty() && !error.problem.is_empty()),
    }
}
