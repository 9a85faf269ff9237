//! Limits the number of elements of a request before it is decoded.
//!
//! An empty element of a repeated field takes two bytes on the wire and up to several hundred decoded: without a limit, a message
//! of a few mebibytes would decode to gigabytes before it could be checked.

use crate::v1;
use prost::encoding::{WireType, decode_varint};
use std::any::TypeId;

/// Elements that any request may have; every [`BYTES_PER_ELEMENT`] bytes of the request allow one more.
pub const ELEMENTS: usize = 131_072;

/// Bytes of a request per additional element.
pub const BYTES_PER_ELEMENT: usize = 16;

/// Elements that a team counts as, in a request for several.
const TEAM: usize = 64;

/// Rejects a request of type `T` with too many elements, with the limit. Malformed bytes are left to the decoder.
pub(crate) fn check<T: 'static>(bytes: &[u8]) -> Result<(), usize> {
    let limit = ELEMENTS + bytes.len() / BYTES_PER_ELEMENT;
    let teams = [TypeId::of::<v1::AssignManyRequest>(), TypeId::of::<v1::AssignStreamRequest>()];
    let mut count = 0;
    if teams.contains(&TypeId::of::<T>()) {
        walk(bytes, &mut |team| {
            count += TEAM;
            count <= limit && walk(team, &mut |_| within(&mut count, limit))
        });
    } else {
        walk(bytes, &mut |_| within(&mut count, limit));
    }
    if count > limit { Err(limit) } else { Ok(()) }
}

fn within(count: &mut usize, limit: usize) -> bool {
    *count += 1;
    *count <= limit
}

/// Calls `seen` with every length-delimited field until it returns false; returns its last value. Fields within a group, which our
/// messages do not have, are counted as if they were outside: never fewer than there are.
fn walk<'a>(mut bytes: &'a [u8], seen: &mut dyn FnMut(&'a [u8]) -> bool) -> bool {
    while !bytes.is_empty() {
        let Ok(tag) = decode_varint(&mut bytes) else { return true };
        let length = match WireType::try_from(tag & 7) {
            Ok(WireType::Varint) => match decode_varint(&mut bytes) {
                Ok(_) => 0,
                Err(_) => return true,
            },
            Ok(WireType::SixtyFourBit) => 8,
            Ok(WireType::ThirtyTwoBit) => 4,
            Ok(WireType::StartGroup | WireType::EndGroup) => 0,
            Ok(WireType::LengthDelimited) => {
                let Ok(length) = decode_varint(&mut bytes) else { return true };
                let Some(field) = usize::try_from(length).ok().and_then(|length| bytes.get(..length)) else {
                    return true;
                };
                if !seen(field) {
                    return false;
                }
                field.len()
            }
            Err(_) => return true,
        };
        let Some(rest) = bytes.get(length..) else { return true };
        bytes = rest;
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost::Message as _;

    #[test]
    fn a_large_valid_request_passes() {
        let id = |k: usize| format!("agent-{k}");
        let pair = |k: usize| v1::PairRef { agent_id: id(k), goal_id: id(k + 1), ..Default::default() };
        let team = v1::AssignRequest {
            agent_ids: (0..5000).map(id).collect(),
            forbidden: (0..200_000).map(pair).collect(),
            ..Default::default()
        };
        check::<v1::AssignRequest>(&team.encode_to_vec()).unwrap();
        let small = v1::AssignRequest { agent_ids: (0..50).map(id).collect(), ..Default::default() };
        let many = v1::AssignManyRequest { teams: vec![small; 1000] };
        check::<v1::AssignManyRequest>(&many.encode_to_vec()).unwrap();
    }

    #[test]
    fn empty_elements_are_counted_however_they_are_nested() {
        let empty_teams = v1::AssignManyRequest { teams: vec![v1::AssignRequest::default(); 4000] }.encode_to_vec();
        assert!(check::<v1::AssignManyRequest>(&empty_teams).is_err());
        let pairs = vec![v1::PairRef::default(); 200_000];
        let team = v1::AssignRequest { forbidden: pairs, ..Default::default() };
        let plain = team.encode_to_vec();
        assert!(check::<v1::AssignRequest>(&plain).is_err());
        assert!(
            check::<v1::AssignStreamRequest>(
                &v1::AssignStreamRequest { sequence: 1, team: Some(team.clone()) }.encode_to_vec()
            )
            .is_err()
        );
        assert!(check::<v1::AssignManyRequest>(&v1::AssignManyRequest { teams: vec![team] }.encode_to_vec()).is_err());
        // Field 99 as a group in front: it hides nothing.
        let grouped = [&[0x9b, 0x06, 0x08, 0x01, 0x9c, 0x06][..], &plain].concat();
        assert!(check::<v1::AssignRequest>(&grouped).is_err());
    }

    #[test]
    fn malformed_bytes_are_left_to_the_decoder() {
        for bytes in [&[0xff][..], &[0x0a, 0x05, 0x01], &[0x0a, 0xff], &[0x09, 0x00], &[0x0f], &[0x08, 0xff]] {
            check::<v1::AssignRequest>(bytes).unwrap();
            check::<v1::AssignManyRequest>(bytes).unwrap();
        }
    }
}
