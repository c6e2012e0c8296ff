//! How much memory the process takes, as the operating system counts it.

/// The most memory that this process has had resident so far, bytes; `None` where the system does not tell (only Linux does).
pub fn peak_resident_bytes() -> Option<u64> {
    peak_in("/proc/self/status")
}

/// The same of the running process of number `process`; `None` also when it has ended.
pub fn peak_resident_bytes_of(process: u32) -> Option<u64> {
    peak_in(&format!("/proc/{process}/status"))
}

fn peak_in(status: &str) -> Option<u64> {
    let status = std::fs::read_to_string(status).ok()?;
    let kilobytes = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?.trim().strip_suffix("kB")?;
    Some(1024 * kilobytes.trim().parse::<u64>().ok()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn peak_covers_what_was_touched() {
        let before = peak_resident_bytes().expect("Linux tells");
        let touched = std::hint::black_box(vec![1_u8; 64 << 20]);
        assert!(peak_resident_bytes().expect("Linux tells") >= (64 << 20).max(before), "{}", touched.len());
    }
}
