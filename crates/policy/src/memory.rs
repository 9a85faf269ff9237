//! What a team carries between two calls, as bytes that say whose they are. The caller keeps them and need not read them.

use crate::acting::ActError;

/// `MXM1`, the first 12 bytes of the weights' SHA-256, agents, teams, then a checksum, then the numbers.
const MAGIC: &[u8; 4] = b"MXM1";
const HEAD: usize = 4 + 12 + 4 + 4;
/// Bytes before the numbers.
const OVERHEAD: usize = HEAD + 4;

/// The memory `values` [B·N, M] of B teams of N agents, of the policy with these weights (SHA-256, hex).
pub fn pack(values: &[f32], sha256: &str, teams: usize, agents: usize) -> Vec<u8> {
    if values.is_empty() {
        return Vec::new();
    }
    let mut bytes = Vec::with_capacity(OVERHEAD + 4 * values.len());
    bytes.extend(head(sha256, teams, agents));
    let numbers: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
    bytes.extend(checksum(&bytes, &numbers).to_le_bytes());
    bytes.extend(numbers);
    bytes
}

fn head(sha256: &str, teams: usize, agents: usize) -> Vec<u8> {
    let mut bytes = MAGIC.to_vec();
    bytes.extend(
        (0..12).map(|k| sha256.get(2 * k..2 * k + 2).and_then(|hex| u8::from_str_radix(hex, 16).ok()).unwrap_or(0)),
    );
    bytes.extend((agents as u32).to_le_bytes());
    bytes.extend((teams as u32).to_le_bytes());
    bytes
}

/// CRC-32C: the memory is checked on every call.
fn checksum(head: &[u8], numbers: &[u8]) -> u32 {
    crc32c::crc32c_append(crc32c::crc32c(head), numbers)
}

/// The numbers, if the bytes are whole and of this policy and these teams; `None` for no bytes, which begin an episode.
///
/// # Errors
/// The bytes are damaged, of another run, or of other teams.
pub fn unpack(bytes: &[u8], sha256: &str, teams: usize, agents: usize) -> Result<Option<Vec<f32>>, ActError> {
    if bytes.is_empty() {
        return Ok(None);
    }
    let damaged = || {
        ActError::invalid(
            "memory",
            "is damaged; send the bytes of the last answer as they are, or none to begin an episode",
        )
    };
    if bytes.len() < OVERHEAD || !bytes.starts_with(MAGIC) || !(bytes.len() - OVERHEAD).is_multiple_of(4) {
        return Err(damaged());
    }
    let (front, numbers) = bytes.split_at(OVERHEAD);
    let (found, sum) = front.split_at(HEAD);
    if sum != checksum(found, numbers).to_le_bytes() {
        return Err(damaged());
    }
    let wanted = head(sha256, teams, agents);
    if found[..16] != wanted[..16] {
        let problem = "belongs to other weights than those that are loaded; send none to begin an episode";
        return Err(ActError::invalid("memory", problem));
    }
    if found != wanted {
        let number = |at: usize| u32::from_le_bytes([found[at], found[at + 1], found[at + 2], found[at + 3]]);
        let problem = format!(
            "belongs to {} teams of {} agents, this call has {teams} of {agents}; send none to begin an episode",
            number(20),
            number(16)
        );
        return Err(ActError::invalid("memory", problem));
    }
    Ok(Some(numbers.chunks_exact(4).map(|x| f32::from_le_bytes([x[0], x[1], x[2], x[3]])).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_its_own_bytes_are_taken_back() {
        let (own, other) = ("ab".repeat(32), "cd".repeat(32));
        let values: Vec<f32> = (0..24).map(|x| x as f32 * 0.1).collect();
        let bytes = pack(&values, &own, 2, 3);
        assert_eq!(unpack(&bytes, &own, 2, 3).unwrap().unwrap(), values);
        assert_eq!(unpack(&[], &own, 2, 3).unwrap(), None);
        let refused =
            |bytes: &[u8], sha256: &str, teams, agents| unpack(bytes, sha256, teams, agents).unwrap_err().to_string();
        assert!(refused(&bytes, &other, 2, 3).contains("other weights"));
        assert!(refused(&bytes, &own, 3, 2).contains("belongs to 2 teams of 3 agents"));
        assert!(refused(&bytes[..bytes.len() - 1], &own, 2, 3).contains("damaged"));
        for at in 0..bytes.len() {
            let mut broken = bytes.clone();
            broken[at] ^= 4;
            assert!(unpack(&broken, &own, 2, 3).is_err(), "{at}");
        }
    }
}
