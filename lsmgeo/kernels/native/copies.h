// Copies of sources whose channels are not adjacent; sources.h fills them. Included by kernels.cpp.

void use_huge_pages(void *, int64_t);

constexpr int64_t SEGMENT = 32;  // pixels of a row that are copied together
enum Progress : uint8_t { UNTOUCHED = 0, BEING_FILLED = 1, READY = 2 };

// A call that reads a copy, where the one given does not read adjacent channels.
struct Copies {
    Call call;
    std::unique_ptr<char[]> memory;
    std::unique_ptr<uint8_t[]> ready;
    int64_t segments = 0;

    // Makes room for some images of the call; false when memory ran out.
    bool reserve(const Call &given, int64_t scenes, int64_t views) {
        call = given;
        if (!call.original) return true;
        const int64_t *size = call.size, x = call.channels, y = x * size[0], z = y * size[1], view = z * size[2];
        const int64_t stride[5] = {scenes > 1 ? view * views : 0, views > 1 ? view : 0, z, y, x};
        std::copy(stride, stride + 5, call.source_stride);
        const int64_t bytes = scenes * views * view * (call.source_type == FLOAT32 ? 4 : 2);
        segments = scenes * views * size[2] * size[1] * ((size[0] + SEGMENT - 1) / SEGMENT);
        memory.reset(new (std::nothrow) char[size_t(bytes)]);
        ready.reset(new (std::nothrow) uint8_t[size_t(segments)]());
        if (!memory || !ready) return false;
        use_huge_pages(memory.get(), bytes);
        call.source = memory.get();
        call.ready = ready.get();
        return true;
    }

    void forget() {
        if (call.original) std::memset(ready.get(), UNTOUCHED, size_t(segments));
    }
};
