//! Whether a JPEG is whole. Decoders fill what is missing of a cut file with grey and call it a success, as viewers want
//! it; training must not learn from that grey.

/// The two bytes every JPEG starts with.
pub(super) const START: [u8; 2] = [0xff, 0xd8];

const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;

/// True when the segments of `bytes`, which begins with [`START`], lead to the end-of-image marker. A search for the
/// marker alone would find the one of an embedded preview.
pub(super) fn is_complete(bytes: &[u8]) -> bool {
    let mut at = START.len();
    loop {
        let Some(marker) = next_marker(bytes, &mut at) else { return false };
        match marker {
            END_OF_IMAGE => return true,
            // Markers without content: temporary, restart, start of image.
            0x01 | 0xd0..=0xd8 => {}
            _ => {
                let Some(length) = bytes.get(at..at + 2) else { return false };
                at += usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
                if marker == START_OF_SCAN {
                    skip_entropy_coded(bytes, &mut at);
                }
            }
        }
    }
}

/// The code of the marker at or after `at`, which moves behind it.
fn next_marker(bytes: &[u8], at: &mut usize) -> Option<u8> {
    *at += bytes.get(*at..)?.iter().position(|&b| b == 0xff)?;
    // A marker may be preceded by any number of fill bytes.
    *at += bytes[*at..].iter().position(|&b| b != 0xff)?;
    *at += 1;
    Some(bytes[*at - 1])
}

/// Moves `at` to the next marker that ends entropy-coded data: a 0xff that is neither stuffed nor a restart.
fn skip_entropy_coded(bytes: &[u8], at: &mut usize) {
    while let Some(offset) = bytes.get(*at..).and_then(|rest| rest.iter().position(|&b| b == 0xff)) {
        *at += offset;
        match bytes.get(*at + 1) {
            Some(0x00 | 0xd0..=0xd7) => *at += 2,
            Some(0xff) => *at += 1,
            _ => return,
        }
    }
    *at = bytes.len();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_marker_of_the_image_itself_counts() {
        // A preview with its own end inside an application segment, then a scan with stuffed bytes and a restart.
        let mut bytes = vec![0xff, 0xd8, 0xff, 0xe1, 0, 6, 0xff, 0xd8, 0xff, 0xd9, 0xff, 0xda, 0, 3, 1];
        bytes.extend([5, 0xff, 0, 6, 0xff, 0xd3, 7, 0xff, 0xff]);
        assert!(!is_complete(&bytes));
        bytes.push(0xd9);
        assert!(is_complete(&bytes));
        bytes.extend([1, 2, 3]);
        assert!(is_complete(&bytes));
    }
}
