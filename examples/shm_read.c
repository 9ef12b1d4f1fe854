/* Prints the newest result of a sensor from shared memory: a reader to copy. docs/middleware.md has the layout.
 *
 *     gcc -O2 examples/shm_read.c -lz -o read && ./read skin 4
 */
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <zlib.h>

/* Copies the newest result of a sensor; 1 if there is one that is young, whose baseline is not in doubt (state 6), and
   that is of a device, or one is to pretend so. Give `half` room for half_bytes, header[3] below. */
static int latest(const uint8_t *memory, const char *sensor, int64_t oldest_ns, int pretend, uint8_t *half) {
    uint32_t header[5]; /* header_bytes, slots, slot_bytes, half_bytes, first_half_at */
    memcpy(header, memory + 12, sizeof header);
    for (uint32_t slot = 0; slot < header[1]; slot++) {
        const uint8_t *at = memory + header[0] + (size_t)slot * header[2];
        for (int attempt = 0; attempt < 100; attempt++) {
            uint64_t stored, sequence = __atomic_load_n((const uint64_t *)at, __ATOMIC_ACQUIRE);
            uint32_t checksum;
            if (sequence == 0) return 0;
            memcpy(half, at + header[4] + (sequence & 1) * header[3], header[3]);
            memcpy(&checksum, half, 4);
            memcpy(&stored, half + 8, 8);
            if (stored != sequence || checksum != crc32(0, half + 8, header[3] - 8)) continue;
            if (strncmp((const char *)half + 184, sensor, 256) != 0) break;
            struct timespec now;
            int64_t time_ns;
            int32_t source, state;
            clock_gettime(CLOCK_MONOTONIC, &now);
            memcpy(&time_ns, half + 16, 8);
            memcpy(&source, half + 48, 4);
            memcpy(&state, half + 52, 4);
            int64_t age_ns = now.tv_sec * INT64_C(1000000000) + now.tv_nsec - time_ns;
            return age_ns >= 0 && age_ns < oldest_ns && state != 6 && (source == 1 || pretend);
        }
    }
    return 0;
}

int main(int count, char **words) {
    static uint8_t half[1 << 16];
    struct stat file;
    char path[128];
    if (count < 3) return 2;
    snprintf(path, sizeof path, "/dev/shm/%s", words[1]);
    int descriptor = open(path, O_RDONLY);
    if (descriptor < 0 || fstat(descriptor, &file) != 0) return 1;
    const uint8_t *memory = mmap(NULL, file.st_size, PROT_READ, MAP_SHARED, descriptor, 0);
    if (memory == MAP_FAILED || memcmp(memory, "TESR-SHM\1\0\0\0", 12) != 0) return 1;
    if (*(const uint32_t *)(memory + 24) > sizeof half) return 1;
    if (!latest(memory, words[2], 50 * 1000000, count > 3, half)) return 1; /* any fourth word: pretend */
    int64_t scan;
    int32_t state;
    double force_counts;
    memcpy(&scan, half + 24, 8);
    memcpy(&state, half + 52, 4);
    memcpy(&force_counts, half + 104, 8);
    printf("state %d scan %lld force_counts %.1f\n", state, (long long)scan, force_counts);
    return 0;
}
